"""The published facts: each file declares one as FACT and is found by its place here."""
