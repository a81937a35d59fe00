"""The published facts, their reproduction, and the fit of the simulator to them."""
