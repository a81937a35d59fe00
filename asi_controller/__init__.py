"""The controller: compensators, reference signals, and the node that closes the force loop."""
