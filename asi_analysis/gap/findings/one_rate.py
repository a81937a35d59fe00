"""An input of one rate does not separate a lag or a delay from hysteresis."""

from typing import Final

from asi_analysis.gap.course import one_rate
from asi_analysis.gap.inference.hypotheses import Weighed

# Effects that turn any input that goes to and fro into a loop. At one rate they differ only at its
# turns, as other laws of hysteresis do.
HYSTERESIS: Final = 'valve_hysteresis'
LATE: Final = ('valve_lag', 'transport_delay')
SUREST: Final = 0.85   # highest probability of one kind against the other at one rate


def at_one_rate(weighed: Weighed) -> Weighed:
    """Return a group in which neither is more probable than SUREST, if the input has one rate."""
    if not one_rate(weighed.group.recordings):
        return weighed
    chance = dict(weighed.probability)
    for loop in [names for names in chance if HYSTERESIS in names and not set(LATE) & set(names)]:
        late = [each for each in chance for name in LATE
                if set(each) == {name if n == HYSTERESIS else n for n in loop}]
        mass = sum(chance[each] for each in late)
        total = mass + chance[loop]
        if not late or total == 0.0:
            continue
        share = min(max(mass / total, 1.0 - SUREST), SUREST)
        for each in late:
            chance[each] = share * total * (chance[each] / mass if mass else 1.0 / len(late))
        chance[loop] = (1.0 - share) * total
    return weighed._replace(probability=chance)
