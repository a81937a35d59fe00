"""`asi tune`: the settings of the controller for an actuator, searched with the attack inside."""
