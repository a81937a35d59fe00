"""The facts that the paper publishes about the actuator, each measured on the simulator."""
