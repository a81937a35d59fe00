"""The physics: one block of the paper's Fig. 2 a file, joined in `actuator.py`."""
