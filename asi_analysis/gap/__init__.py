"""
The sim-to-real gap: where it lies, which effect causes it, how far it shrinks, what is next.

`prepare` (a recording on one clean time base) -> `blocks` (each driven by its measured input, with
every effect of `effects` in it, null by default) -> `predict` -> `group` (channels that are fitted
together) -> `fit` -> `verdict` -> `shrink`, `where`, `uncertainty`, `next_experiment`,
`next_motion` -> `report`. How it works and where it fails: doc/explanation/gap.md.
"""
