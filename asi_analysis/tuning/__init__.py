"""The force loop of an actuator: its figures, controllers compared by them, and searched."""
