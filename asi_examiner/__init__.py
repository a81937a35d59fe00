"""
The blind examiner: writes recordings of a plant with a withheld effect, and the sealed answers.

It shares no code with the diagnosis, except for own.py, which is the simulator itself, and is
never imported by it. Its plant formulates every effect differently (plant.py lists how) and has
another integrator and another step.
"""
