"""The actuator: physics, parameters, and the node that simulates it."""
