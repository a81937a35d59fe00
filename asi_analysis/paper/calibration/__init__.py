"""The fit of the simulator to the published facts, and the parameters that they leave open."""
