"""
A gain: the command is the error of the force times the gain, and the feed-forward.

Section 3 of the paper: above a certain gain the loop has a limit cycle.
"""

from asi_controller.design import Compensator, Design


def design(gain: float) -> Design:
    """Return a gain without zeros and poles."""
    return Design((), (), gain)


COMPENSATOR = Compensator('proportional', gain=3.0, order=10, design=design)
