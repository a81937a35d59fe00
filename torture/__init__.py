"""Fault injection in processes, links, files and clocks; counts the losses (`make torture`)."""
