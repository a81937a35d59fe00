"""How reports and pictures are written."""
