"""
The sim-to-real gap: where it lies, which effect causes it, how far it shrinks, what is next.

`prepare` (uniform sampling, noise, parts of the data) -> `model`: `blocks`, each driven by its
measured input and with all `effects`, null by default, and `simulator`, with them in the `forms`
of its own parameters; `predict`; `group` (channels fitted together) -> `inference`: `search` and
`posterior` (the simulator), then `fit`, `initial_guesses`, `hypotheses`, `probability`, `shrink`,
`localisation`, `uncertainty` -> `experiment` (what to record next) -> `answer` (document, report).
How it works and where it fails: doc/explanation/gap.md.
"""
