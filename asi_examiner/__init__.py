"""
The blind examiner: writes recordings of a plant with a withheld effect, and the sealed answers.

It shares no code with the diagnosis and is never imported by it. Its plant has another formulation
of every effect (each is named in plant.py), another integrator and another step.
"""
