"""Is there a limit cycle in a recording: found, measured, told from what only looks like one."""
