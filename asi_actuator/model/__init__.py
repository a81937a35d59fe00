"""The physics: one file per block of the paper's Fig. 2, joined in `actuator.py`."""
