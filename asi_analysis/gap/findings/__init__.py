"""What follows from the fits: where the gap lies, how far it shrinks, and what they leave open."""
