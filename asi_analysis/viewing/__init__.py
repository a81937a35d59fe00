"""What shows a loop: the live page in the browser, and recordings in the Rerun viewer."""
