"""
The sim-to-real gap: where it lies, which effect causes it, how far it shrinks, what is next.

In the order of the data: `parts`, `sampling`, `motion` -> `prepare` (recordings ready to compare)
-> `model` (predicts a channel, by `blocks` driven by measured inputs or by the `simulator`; every
effect is null by default) -> `inference` (fits and probabilities of the hypotheses) -> `findings`
(where the gap lies, how far it shrinks) and `experiment` (what to record next) -> `diagnose` ->
`answer` (document, report, export) -> `check` (on blind cases).
How it works: doc/explanation/gap_method.md; how often it is right: gap_check.md beside it.
"""
