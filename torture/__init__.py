"""`make torture`: break everything that a lab breaks, and count what is lost."""
