"""The experiment that would separate the hypotheses that are left."""
