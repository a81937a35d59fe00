"""The result of a diagnosis: document, tables, report, pictures and improved model file."""
