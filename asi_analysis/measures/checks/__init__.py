"""What can be wrong with a recording: each check tells the samples, and why."""
