"""Detection: whether a recorded oscillation is a limit cycle, and with what confidence."""
