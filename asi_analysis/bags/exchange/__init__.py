"""Import of other people's recordings, and export as tables."""
