"""Is a recorded oscillation a limit cycle: detection in a bag, with its confidence."""
