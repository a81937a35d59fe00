"""What the code costs, measured beside what it is measured against: `make bench`."""
