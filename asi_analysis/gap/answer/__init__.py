"""The answer for people and scripts: document, report, pictures, model file."""
