"""The published facts: each file declares one as FACT and is found from here."""
