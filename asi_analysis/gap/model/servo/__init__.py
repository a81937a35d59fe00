"""The servo of a joint: its law, its identification, its effects, steps of its reference."""
