"""What the simulator is fitted to the published facts by, and what they leave open."""
