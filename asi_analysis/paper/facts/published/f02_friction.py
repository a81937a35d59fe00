"""F2: Coulomb friction and stiction."""

from asi_analysis.paper.facts.fact import Fact, Role, Setup, around
from asi_analysis.paper.facts.static import breakaway, coulomb


def measure(setup: Setup) -> dict[str, float]:
    return {'coulomb_n': coulomb(setup.actuator, setup.refinement),
            'stiction_push_n': breakaway(setup.actuator, 1, setup.refinement),
            'stiction_pull_n': breakaway(setup.actuator, -1, setup.refinement)}


FACT = Fact(
    'F2',
    (around('coulomb_n', 'Coulomb friction', '2.2', 7.0, 'N', 0.03, Role.GIVEN),
     around('stiction_push_n', 'stiction, pushing', '2.2', 27.0, 'N', 0.03, Role.GIVEN),
     around('stiction_pull_n', 'stiction, pulling', '2.2', 15.0, 'N', 0.03, Role.GIVEN)),
    measure,
    lambda _: 'valve closed; piston moved at a prescribed speed',
    'stiction: largest force of a slow motion; Coulomb: force when sliding, less that without '
    'friction')
