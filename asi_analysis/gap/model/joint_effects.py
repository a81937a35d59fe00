"""The candidate effects between the force and the motion of a joint."""

from collections.abc import Sequence

from asi_analysis.gap.model.coupling import MOST_SHARE, Coupling
from asi_analysis.gap.model.effects import (
    ASYMMETRIES,
    DRIVE_GAIN,
    EFFECTS,
    FLOATING,
    POSITION_GAIN,
    Effects,
    Free,
    Variant,
)

# Breakaway distance of friction, share of the range of motion: from bearings to rubber seals.
BRISTLE = (1e-5, 0.1)
# A load behind a compliance may oscillate at the start of a recording; damping may be before it.
LOAD_SWING = (*(Free(f'swing_{part}', -3.0, 3.0, (0.0,), 'force') for part in ('cosine', 'sine')),
          Free('damping_share', 0.0, 1.0, (0.5,)))
# A stiff coupling, of which the motion shows the resonance: the compliance over that which would
# explain the whole motion, on a logarithmic scale. A resonance guides a fit over a factor of two.
STIFF = {'compliance': Free('compliance', 1e-5, 0.1, (
             0.001, 0.002, 0.004, 0.008, 0.015, 0.03, 0.06), 'compliance', 'm/N'),
         'piston_share': Free('piston_share', 0.0, 0.8, (0.5, 0.1))}
# Velocity about which friction rises that has no deflection: of a lubricated contact, and of many
# simulators. Not stiction: with the fall after it, that would be any drag with a peak.
CREEP = Free('friction_creep', 1e-4, 0.5, (0.003, 0.03), 'velocity', 'm/s')
NO_OFFSET = Free('load_offset', -0.02, 0.02, (0.0,), 'force')
# Delays and lags of a joint, s: ten times those of a valve, for slow machines; or in samples.
LONGEST, LONGEST_SAMPLES = 1.0, 20
LOOP_TIMES = (0.001, 0.004, 0.015, 0.06, 0.2)


def joint_effects(period: float, travel: float, mass_given: bool, force_measured: bool,
                  rattling: Sequence[Variant], coupling: Coupling | None = None,
                  rubs: bool = False) -> Effects:
    """
    Return the candidate effects between the force and the motion of a joint.

    period: of the samples, s; travel: range of motion, m or rad; mass_given: the mass is known, so
    that a gain error of the force can be identified; force_measured: not only commanded; coupling:
    where the fit of a compliance begins, too; rubs: friction is given, so that how it begins to
    slide is no effect. Effects that equal free parameters of the nominal model are left out: a
    constant disturbance equals an offset. So does the constant part of asymmetric friction, which
    is fitted without an offset.
    """
    covered = {'disturbance', 'sensor_offset'}
    if not mass_given:
        covered |= {'viscous', 'sensor_gain_error'}
    if not force_measured:
        covered |= {'sensor_gain_error', 'sensor_lag', 'sensor_lag_split', 'sensor_drift',
                    'sensor_drift_curve', 'sensor_drift_bend'}
    least, most = (share * travel for share in BRISTLE)
    longest = max(LONGEST, LONGEST_SAMPLES * period)
    wider = {'friction_bristle': Free('', least, most, (100.0 * least, 0.1 * most, 0.5 * most)),
             'friction_level': Free('', 0.0, 1.5, (0.02, 0.1, 0.3, 0.9), 'force'),
             'sensor_lag': Free('', 0.0, longest, LOOP_TIMES)}

    def applies(variant: Variant) -> bool:
        fields = variant.fields
        return 'load' in variant.channels and not fields <= covered

    def scaled(variant: Variant) -> Variant:
        free = tuple(wider[free.field]._replace(field=free.field, unit=free.unit)
                     if free.field in wider else free for free in variant.free
                     if free.field != 'friction_asymmetry' or not variant.joined)
        uneven = any(each.field == 'friction_asymmetry' for each in free)
        behind = any(each.field == 'compliance' for each in free) and not variant.fixed
        return variant._replace(free=(*free, *[NO_OFFSET] * uneven, *LOAD_SWING * behind))

    effects = {name: forms for name, variants in EFFECTS.items()
               if (forms := tuple(form for each in variants if applies(each) for form in (
                   rattling if FLOATING in each.fixed else (scaled(each),))))}
    # An asymmetry of the sliding friction alone is a constant force; beside another one, that of
    # the viscous friction tells it.
    sliding = effects['coulomb_friction'][0]
    effects['friction_asymmetry'] += tuple(sliding._replace(free=(
        *sliding.free, Free('viscous_asymmetry', low, high, (start,))))
        for low, high, start in ASYMMETRIES)
    for name in ('coulomb_friction', 'friction_asymmetry') if not rubs else ():
        effects[name] += tuple(_creeping(form) for form in effects[name]
                               if not form.joined and 'viscous_asymmetry' not in form.fields)
    soft, = effects['load_compliance']
    effects['load_compliance'] = (
        soft, soft._replace(free=tuple(STIFF.get(free.field, free) for free in soft.free)),
        *_coupled(soft, coupling, mass_given))
    effects |= POSITION_GAIN if mass_given else {}
    if not force_measured:
        # A delay at most as long as what is mirrored at the ends of a recording.
        late = {field: Free(field, period, last, starts, '', 's') for field, last, starts in (
            ('drive_delay', max(0.1, LONGEST_SAMPLES * period), (0.002, 0.006, 0.02)),
            ('drive_lag', longest, LOOP_TIMES))}
        # Two forms, since each parameter makes a form less probable.
        late_forms: dict[str, list[tuple[Free, ...]]] = {
            'transport_delay': [(late['drive_delay'],)],
            'valve_lag': [(late['drive_lag'],),
                          (late['drive_lag'], Free('drive_lag_split', 0.0, 0.5, (0.3,)))]}
        effects |= DRIVE_GAIN if mass_given else {}
        effects |= {name: tuple(Variant(each, ('load',)) for each in own)
                    for name, own in late_forms.items()}
    return effects


def _creeping(form: Variant) -> Variant:
    """Return a form of friction that rises with the velocity, not with the displacement."""
    return form._replace(free=(*(free for free in form.free if free.field not in (
        'friction_bristle', 'friction_rounding')), CREEP))


def _coupled(soft: Variant, coupling: Coupling | None, mass_given: bool) -> tuple[Variant, ...]:
    """Return the compliance with the parameters of a guess, from which mass and damping begin."""
    if coupling is None:
        return ()
    began = {'compliance': coupling.compliance, 'load_mass': coupling.mass,
             'load_damping': coupling.damping, 'compliance_damping': coupling.damping_time,
             'piston_share': coupling.share}
    most = {'piston_share': MOST_SHARE,
            'compliance_damping': max(0.02, 3.0 * coupling.damping_time),
            'load_damping': 10.0 * coupling.damping + coupling.mass}
    free = [each._replace(low=0.0, high=most.get(each.field, 10.0 * began[each.field]), scale='',
                          starts=(began[each.field],)) if each.field in began else each
            for each in soft.free]
    if not mass_given:
        free += [Free(name, 0.0, most.get(name, 10.0 * began[name]), (began[name],), anew=True)
                 for name in ('load_mass', 'load_damping')]
    return (soft._replace(free=tuple(free)),)
