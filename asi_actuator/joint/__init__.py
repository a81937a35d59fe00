"""A joint as a model: one block a file, joined in `joint.py`; friction as the actuator's."""
