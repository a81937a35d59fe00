"""
What `--json` prints, command by command: the source of doc/json.md and of its test.

`python -m asi_analysis.json_keys > doc/json.md` writes the page anew.
"""

from typing import Any, Final, NamedTuple


class Key(NamedTuple):
    """
    One key of a document.

    kind: number, integer, text, boolean, object, [object], [text], or one of these with '?' for
    "or null". keys: what an object, or each object of a list, holds; none: anything.
    """

    name: str
    kind: str
    meaning: str
    keys: tuple['Key', ...] = ()


_STEP: Final = (
    Key('rise_time_s', 'number?', '10 to 90 % of the way to the force that is reached'),
    Key('overshoot_percent', 'number?', 'largest force beyond the one reached, share of the step'),
    Key('settling_time_2_s', 'number?', 'from the jump of the reference until the force stays '
        'within 2 % of the step about the force reached; null: it does not stay'),
    Key('settling_time_5_s', 'number?', 'the same with 5 %'),
    Key('steady_state_error_n', 'number?', 'reference less the mean force over the last fifth '
        'of the time after the step'),
    Key('rise_shape', 'text?', 'monotone; or dip, spike, creep: then the rise time says little'),
    Key('monotone_rise', 'boolean?', 'whether rise_shape is monotone'),
)

ANALYZE: Final = (
    Key('source', 'text', 'what was analysed'),
    Key('samples', 'integer', 'samples of the run'),
    Key('duration_s', 'number', 'length of the run'),
    Key('rate_hz', 'number', 'samples a second'),
    *_STEP,
    Key('bandwidth_hz', 'number?', 'where the gain from reference to force has fallen by 3 dB'),
    Key('bandwidth_method', 'text?', 'excitation: spectra of chirp, multisine or PRBS; step: '
        'spectrum of the differentiated step response'),
    Key('actuator_bandwidth_hz', 'number?', 'the same from valve command to force, if the '
        'reference excites enough frequencies'),
    Key('delay_s', 'number?', 'lag of the force behind the reference, from the slope of the '
        'phase up to the bandwidth'),
    Key('correlation_delay_s', 'number?', 'shift at which force and reference are most alike'),
    Key('oscillation', 'object', 'self-sustained oscillation of the force at the end of the run', (
        Key('sustained', 'boolean?', 'false: none, or one that dies out; null: cannot be told'),
        Key('frequency_hz', 'number?', 'its frequency'),
        Key('amplitude_n', 'number?', 'amplitude of its fundamental'))),
    Key('steps', '[object]', 'every step; the keys above are those of the largest, the first of '
        'equals', (
            Key('time_s', 'number', 'when the reference jumps'),
            Key('initial_n', 'number', 'reference before'),
            Key('final_n', 'number', 'reference after'),
            *_STEP,
            Key('notes', '[text]', 'why a value is null or to be doubted'))),
    Key('states', '[object]', "the states that the actuator's node was in, if the bag tells", (
        Key('time_s', 'number', 'from when on'),
        Key('state', 'text', 'disabled, enabled, or fault: the valve command is 0'),
        Key('reason', 'text', 'of a fault: signal, value and limit'))),
    Key('notes', '[text]', 'why a value is null or to be doubted'),
)

_CAUSE: Final = (
    Key('nonlinearity', 'text', 'a nonlinearity of the model; or, by shape: stiction, '
        'backlash, hysteresis, saturation, tight_tuning, disturbance'),
    Key('necessary', 'boolean?', 'no cycle without it; null: judged by shape'),
    Key('sufficient', 'boolean?', 'a cycle with it alone'),
    Key('share', 'number?', 'Shapley value of the amplitude, over the amplitude'),
    Key('probability', 'number', 'that it is the cause'),
    *(Key(f'{prefix}_{name}', 'number?', meaning)
      for prefix in ('alone', 'all_but') for name, meaning in (
          ('frequency_hz', 'simulated cycle with it alone, or all but it'),
          ('amplitude_n', 'its amplitude'),
          ('predicted_frequency_hz', 'the same by harmonic balance'),
          ('predicted_amplitude_n', 'its amplitude'),
          ('onset_gain', 'least gain at which a step leaves a cycle'))),
)

SEGMENTS: Final = Key(
    'segments', '[object]', 'the stretches of each bag, in the order of time', (
        Key('source', 'text', 'bag'),
        Key('signal', 'text', 'signal that was judged'),
        Key('unit', 'text', 'its unit: that of the amplitudes, whatever their name says'),
        Key('start_s', 'number', 'begin'),
        Key('end_s', 'number', 'end'),
        Key('verdict', 'text', 'limit_cycle, decaying, growing, forced, saturating, noise or '
            'unsteady'),
        Key('confidence', 'number', 'probability of the verdict, 0 to 1'),
        Key('why', 'text', 'what speaks for it; for a closed orbit not shown to be isolated, '
            'the run that would show it'),
        Key('cycles', 'number', 'cycles in the segment'),
        Key('frequency_hz', 'number?', 'of the fundamental; null: no oscillation'),
        Key('frequency_low_hz', 'number?', 'its interval at 95 %: low end'),
        Key('frequency_high_hz', 'number?', 'high end'),
        Key('amplitude_n', 'number?', 'amplitude of the fundamental'),
        Key('amplitude_low_n', 'number?', 'its interval at 95 %: low end'),
        Key('amplitude_high_n', 'number?', 'high end'),
        Key('thd', 'number?', 'rms of the harmonics over that of the fundamental'),
        Key('harmonics', '[number]', 'amplitudes over that of the first'),
        Key('envelope_rate_1_s', 'number?', 'growth of the logarithm of the amplitude'),
        Key('envelope_rate_low_1_s', 'number?', 'its interval at 95 %: low end'),
        Key('envelope_rate_high_1_s', 'number?', 'high end'),
        Key('return_map_slope', 'number?', 'slope of each peak against the one before: the '
            'Poincaré map; below 1 it attracts'),
        Key('orbit_closure', 'number?', 'rms distance to the orbit one cycle earlier, over '
            'the rms of the signal; 0: closed'),
        Key('came_from', 'text', 'inside, outside: how the orbit was reached; disturbed: it '
            'had been left; empty: the record does not show it'),
        Key('isolated', 'boolean', 'whether these bags show that the orbit is isolated')))
_GAP: Final = (
    Key('before_nrmse', 'number', 'error of the nominal model over the rms of the signal'),
    Key('refitted_nrmse', 'number', 'with its uncertain parameters refitted'),
    Key('after_nrmse', 'number', 'with the effects of the verdict'),
    Key('noise_floor_nrmse', 'number', 'what noise alone leaves'),
    Key('shrink', 'number', '1 - after / before'),
    Key('shrink_low', 'number', 'low end of its 95 % interval'),
    Key('shrink_high', 'number', 'high end'),
)

DOCUMENTS: Final[dict[str, tuple[Key, ...]]] = {
    'asi analyze': ANALYZE,
    'asi run': (
        Key('bag', 'text', 'path of the bag'),
        Key('mode', 'text', 'lockstep or realtime'),
        Key('ticks', 'integer', 'states that the actuator was to publish'),
        Key('compensator', 'text', 'name of the compensator'),
        *ANALYZE),
    'asi demo': (
        Key('report', 'text', 'path of the report'),
        Key('runs', '[object]', 'what was run, each with its bag', (
            Key('name', 'text', 'name of the run'),
            Key('bag', 'text', 'path of the bag'),
            Key('analysis', 'object', 'as `asi analyze`', ANALYZE))),
        Key('table_1', '[object]', "the paper's Table 1 beside this model", (
            Key('compensator', 'text', 'row'),
            Key('quantity', 'text', 'column'),
            Key('unit', 'text', 'unit of both figures'),
            Key('published', 'text', 'figure of the paper, in its words'),
            Key('simulated', 'number?', 'figure of this run'))),
    ),
    'asi reproduce': (
        Key('facts', '[object]', 'one row of the table each', (
            Key('id', 'text', 'F1 to F18; a fact of several quantities has several rows'),
            Key('quantity', 'text', 'what is measured'),
            Key('published', 'number', 'value of the paper, or the limit that its words set'),
            Key('simulated', 'number?', 'value of the simulator; null: it does not exist, as '
                'the settling time of a loop that does not settle'),
            Key('unit', 'text', 'unit of both'),
            Key('tolerance', 'text', 'which values meet the fact'),
            Key('met', 'boolean', 'whether this one does'),
            Key('section', 'text', 'section, figure or table of the paper'),
            Key('conditions', 'text', 'load, step and controller'),
            Key('method', 'text', 'how it was measured'),
            Key('role', 'text', 'given: the model is told it; fitted: the calibration aims '
                'at it; held out: it does not'))),
        Key('met', 'integer', 'rows met'),
        Key('total', 'integer', 'rows'),
        Key('ids_met', '[text]', 'facts all of whose rows are met'),
        Key('ids_total', 'integer', 'facts'),
        Key('over_ros', '[object]', 'closed-loop values measured with the real nodes as well; '
            'empty: not asked for', (
                Key('value', 'text', 'name of the value'),
                Key('in_process', 'number?', 'from the simulation in one process'),
                Key('over_ros', 'number?', 'from the bag'),
                Key('equal', 'boolean', 'whether they are the same to the last bit'))),
        Key('report', 'text?', 'path of the report; null: none was asked for')),
    'asi limit-cycle': (SEGMENTS,),
    'asi run --experiment isolation': (
        Key('bags', '[text]', 'paths of the run from inside and that from outside'),
        SEGMENTS),
    'asi limit-cycle --check': (
        Key('accuracy', '[object]', 'sines of known truth', (
            Key('cycles', 'number', 'cycles in the record'),
            Key('samples_a_cycle', 'number', 'samples a cycle'),
            Key('snr_db', 'number', 'power of the sine over that of the noise'),
            Key('frequency_error_over_bound', 'number', 'rms error over the Cramér-Rao bound'),
            Key('amplitude_error_over_bound', 'number', 'the same for the amplitude'),
            Key('frequency_coverage', 'number', 'share of the 95 % intervals that hold the truth'),
            Key('amplitude_coverage', 'number', 'the same for the amplitude'))),
        Key('verdicts', '[object]', 'families of signals of known kind', (
            Key('family', 'text', 'kind of signal'),
            Key('truth', 'text', 'verdict that is right'),
            Key('count', 'integer', 'signals'),
            Key('right', 'integer', 'right verdicts'),
            Key('false_limit_cycles', 'integer', 'signals wrongly called a limit cycle'),
            Key('verdicts', 'object', 'how often each verdict was given'))),
    ),
    'asi predict': (
        Key('compensator', 'text', 'name of the compensator'),
        Key('rate_hz', 'number', 'control rate; the loop answers within the period'),
        Key('reference_n', 'number', 'force that the loop is to hold'),
        Key('cycles', '[object]', 'cycles that exist, stable or not', (
            Key('gain', 'number', 'gain of the compensator'),
            Key('frequency_hz', 'number', 'frequency'),
            Key('amplitude_n', 'number', 'amplitude of the fundamental of the measured force'),
            Key('stable', 'boolean', "whether it attracts: Loeb's criterion (describing "
                'function), which side of the fold (balance), reached (simulation)'),
            Key('method', 'text', 'describing_function: the hysteresis alone, one harmonic; '
                'harmonic_balance: all nonlinearities; simulation'),
            Key('thd', 'number?', 'rms of the harmonics over the fundamental'),
            Key('second_multiplier', 'number?', 'size of the largest Floquet multiplier beside '
                'that along the orbit; null: no simulated cycle there'))),
        Key('onset_gain', 'number?', 'least gain at which a cycle exists: fold of the harmonic '
            'balance; null: no cycle found'),
        Key('onset_frequency_hz', 'number?', 'frequency there'),
        Key('onset_amplitude_n', 'number?', 'amplitude there'),
        Key('describing_function_onset_gain', 'number?', 'first intersection, hysteresis alone'),
        Key('describing_function_onset_frequency_hz', 'number?', 'frequency there'),
        Key('linear_limit_gain', 'number?', 'gain at which the loop is unstable without '
            'hysteresis, damping and friction'),
        Key('largest_frequency_error', 'number?', 'balance against simulation, share'),
        Key('largest_amplitude_error', 'number?', 'the same for the amplitude'),
        Key('one_harmonic', '[object]', 'the first cycle of each nonlinearity alone', (
            Key('nonlinearity', 'text', 'hysteresis, characteristic, damping, friction, limit'),
            Key('onset_gain', 'number?', 'null: no cycle at any gain'),
            Key('onset_frequency_hz', 'number?', 'frequency there'))),
        Key('onset_by_step', '[object]', 'onset by the size of the step, if asked for', (
            Key('step_n', 'number', 'step of the reference'),
            Key('predicted_gain', 'number?', 'fold of the harmonic balance'),
            Key('predicted_frequency_hz', 'number?', 'frequency there'),
            Key('simulated_gain', 'number?', 'least gain at which the step leaves a cycle'),
            Key('simulated_frequency_hz', 'number?', 'frequency there'))),
    ),
    'asi attribute': (
        Key('gain', 'number?', 'gain at which the cycles are compared; null: no cycle'),
        Key('rate_hz', 'number', 'control rate'),
        Key('onset_gain', 'number?', 'least gain at which a step leaves a cycle'),
        Key('frequency_hz', 'number?', 'cycle with all nonlinearities'),
        Key('amplitude_n', 'number?', 'its amplitude'),
        Key('causes', '[object]', 'the nonlinearities', (
            *_CAUSE,)),
        Key('verdict', 'text', 'what causes the cycle, with the numbers')),
    'asi attribute BAG': (
        Key('source', 'text', 'bag'),
        Key('start_s', 'number', 'begin of the stretch'),
        Key('end_s', 'number', 'end'),
        Key('oscillation', 'text', 'verdict of `asi limit-cycle` on it'),
        Key('frequency_hz', 'number?', 'measured'),
        Key('amplitude_n', 'number?', 'measured'),
        Key('causes', '[object]', 'by shape, the most probable first; or, if the bag holds '
            'the configuration of this actuator, by its model', (
            *_CAUSE,
            Key('unexplained', 'number?', 'share of the output that this kind of valve, followed '
                'by a linear process, leaves unexplained'),
            Key('frequency_error', 'number?', 'cycle with it alone against the measured one'),
            Key('amplitude_error', 'number?', 'the same for the amplitude'))),
        Key('verdict', 'text', 'the cause in words; cannot tell, and what would')),
    'asi quench': (
        Key('compensator', 'text', 'name of the compensator'),
        Key('rate_hz', 'number', 'control rate of margin, dither and design'),
        Key('margin', 'number', 'least distance between the loop and -1/N in the Nyquist plane, '
            'over amplitudes, biases and loads; 0: a cycle is predicted'),
        Key('margin_at', 'object', 'where it is least', (
            Key('amplitude_n', 'number', 'of the command'),
            Key('bias_n', 'number', 'force held'),
            Key('frequency_hz', 'number', 'frequency'),
            Key('load', 'text', 'load'))),
        Key('conditions_tried', 'integer', 'conditions of the attack'),
        Key('sustained_found', 'integer', 'those that left a sustained oscillation'),
        Key('worst_amplitude_n', 'number?', 'half the swing of the largest; 0: none; null: '
            'unbounded'),
        Key('worst', '[object]', 'the most threatening conditions', (
            Key('amplitude_n', 'number?', 'half the swing that is left'),
            Key('sustained', 'boolean', 'whether it lasts'),
            Key('frequency_hz', 'number?', 'its frequency, roughly'),
            Key('condition', 'object', 'parameters of actuator and reference, control rate'))),
        Key('replayed', '[object]', 'the worst finds run over ROS, if asked for', (
            Key('bag', 'text', 'path of the bag'),
            Key('verdict', 'text', 'of `asi limit-cycle` on its last segment, or fault'),
            Key('confidence', 'number', 'of the verdict'),
            Key('why', 'text', 'in words'),
            Key('amplitude_n', 'number?', 'null: it comes to rest'),
            Key('frequency_hz', 'number?', 'its frequency'))),
        Key('dither', '[object]', 'rival cure, if the loop cycles', (
            Key('frequency_hz', 'number', 'of the dither'),
            Key('amplitude_n', 'number?', 'least command that quenches; null: none'),
            Key('least_left', 'number', 'least share of the cycle that any amplitude leaves'),
            Key('least_left_at_n', 'number', 'that amplitude'),
            Key('valve_travel_m_s', 'number?', 'mean speed of the valve with it'),
            Key('force_ripple_n', 'number?', 'rms force with it'))),
        Key('design', 'object?', 'best design found, if asked for', (
            Key('rival', 'object', "the compensator: Table 1's measures, margin, noise gain"),
            Key('best', 'object', 'the best design, the same'),
            Key('beats_rival', 'boolean', 'in all four measures, at no smaller margin'),
            Key('designs_tried', 'integer', 'candidates'),
            Key('noise_gain_limit', 'number', 'rms of command over that of sensor noise'),
            Key('trade_off', '[object]', 'fastest rise for each margin', (
                Key('margin', 'number', 'limit-cycle margin'),
                Key('rise_time_s', 'number', 'rise time'),
                Key('overshoot_percent', 'number', 'overshoot')))))),
    'asi calibrate': (
        Key('evaluations', 'integer', 'candidates that the global search has tried'),
        Key('stages', 'object', 'how many of them were measured in each stage of the race'),
        Key('polish_evaluations', 'integer', 'candidates of the polish, all measured in full'),
        Key('cost', 'number', 'of the best one; 0: every row well inside its limits'),
        Key('met', 'integer', 'rows met, of those that the fit aims at, as the search measures'),
        Key('total', 'integer', 'rows that the fit aims at'),
        Key('not_met', '[text]', 'names of the values that are not met'),
        Key('best', 'text', 'path of the best candidate')),
    'asi calibrate --front': (
        Key('quantity', 'text', 'what is held'),
        Key('front', '[object]', 'one entry a value', (
            Key('value', 'number', 'of the quantity'),
            Key('cost', 'number', 'of the best found there'),
            Key('evaluations', 'integer', 'candidates measured in full'),
            Key('not_met', '[text]', 'names of the values that are not met'))),
        Key('out', 'text', 'directory of table and picture')),
    'asi gap': (
        Key('verdict', 'text', 'the effect, or effects joined by +; no_gap; unknown'),
        Key('probability', 'number', 'of the verdict'),
        Key('where', '[object]', 'blocks, the largest share first', (
            Key('block', 'text', 'command_path, valve, hydraulics, mechanics or sensor'),
            Key('share', 'number', 'of the gap, 0 to 1'))),
        Key('which', '[object]', 'effects, the most probable first', (
            Key('effect', 'text', 'its name'),
            Key('block', 'text', 'where it acts'),
            Key('probability', 'number', 'that it is at work, alone or with another'),
            Key('parameters', 'object', 'fitted parameters, SI units; doc/gap.md'),
            Key('parameters_low', 'object', 'of their 95 % intervals'),
            Key('parameters_high', 'object', 'of their 95 % intervals'))),
        Key('no_gap_probability', 'number', 'that there is nothing beyond noise and tolerance'),
        Key('unknown_probability', 'number', 'that something else is at work'),
        Key('ambiguity_set', '[text]', 'verdicts that hold the truth with 90 %'),
        Key('gap', 'object', 'of the channel in which the verdict explains most, on held-out data',
            (Key('channel', 'text', 'valve, force or load'), *_GAP)),
        Key('channels', '[object]', 'the same for every channel',
            (Key('channel', 'text', 'valve, force or load'), *_GAP)),
        Key('chain', 'object?', 'share of each part of the chain in the gap of the force '
            '(Shapley); null: a signal is missing'),
        Key('regimes', '[object]', 'where in frequency, amplitude, motion and time the gap is', (
            Key('kind', 'text', 'frequency, amplitude, velocity ...'),
            Key('regime', 'text', 'which part'),
            Key('relative', 'number', 'rms of the gap there over that everywhere, model refitted'),
            Key('after', 'number', 'the same, with the effects of the verdict'),
            Key('share', 'number', 'of the samples'))),
        Key('unexplained', 'text?', 'what the unexplained part depends on; null: unknown is not '
            'among the answers'),
        Key('consequences', '[object]', 'what the gap does to the closed loop; none for a joint', (
            Key('quantity', 'text', 'onset_gain, rise_time_s ...'),
            Key('nominal', 'number?', 'of the model as given; null: none, such as no onset'),
            Key('improved', 'number?', 'of the model with the verdict put in'),
            Key('improved_low', 'number?', '95 % interval'),
            Key('improved_high', 'number?', '95 % interval'),
            Key('measured', 'number?', 'in the first recording; null: it does not show it'))),
        Key('next_experiment', 'object?', 'what would separate what is left; null: nothing to '
            'separate, or no experiment of the catalogue does'),
        Key('notes', '[text]', 'what is doubtful, or cannot be told from these signals'),
        Key('sources', '[text]', 'the recordings'),
        Key('nuisance', 'object', 'the uncertain nominal parameters as refitted, by channel'),
        Key('report', 'text?', 'path of the report; null: none was asked for')),
    'asi gap check': (
        Key('cases', 'integer', 'blind cases'),
        Key('block_accuracy', 'number?', 'one effect: its block has the largest share'),
        Key('effect_accuracy', 'number?', 'one effect: it is named first'),
        Key('ambiguity_coverage', 'number?', 'one effect: it is in the ambiguity set'),
        Key('mean_ambiguity_size', 'number?', 'one effect: size of that set'),
        Key('false_alarm_rate', 'number?', 'no gap: something else was said'),
        Key('small_wrong_rate', 'number?', 'too small to see: another effect was named'),
        Key('unknown_rate', 'number?', 'outside the vocabulary: unknown was said'),
        Key('pair_rate', 'number?', 'two effects: both have a probability above one half'),
        Key('pair_one_rate', 'number?', 'two effects: at least one has'),
        Key('confidently_wrong_rate', 'number', 'of all: wrong with 0.9 or more'),
        Key('calibration_error', 'number', 'probability said against share right, by bins'),
        Key('shrink_within_005', 'number?', 'shrink on a fresh recording within 0.05'),
        Key('interval_coverage', 'number?', 'the 95 % interval holds the fresh shrink'),
        Key('size_coverage', 'number?', 'effects named rightly: the 95 % interval of a size holds '
            'the true one'),
        Key('median_seconds', 'number', 'processor time of a case'),
        Key('refused', 'integer', 'cases refused as unusable'),
        Key('by_kind', 'object', 'number of cases of each kind'),
        Key('by_excitation', 'object', 'effect_accuracy by excitation'),
        Key('by_effect', 'object', 'effect_accuracy by effect; null: no such case'),
        Key('reliability', '[object]', 'of the verdicts', (
            Key('said', 'number', 'mean probability of a bin'),
            Key('right', 'number', 'share that was right'),
            Key('cases', 'integer', 'how many'))),
        Key('wrong', '[object]', 'cases judged wrong', (
            Key('bag', 'text', 'which'), Key('truth', 'text', 'what was right'),
            Key('verdict', 'text', 'what was said'),
            Key('probability', 'number', 'and how surely'))),
        Key('directory', 'text', 'of the cases; now with rows.jsonl, answers.json, confusion.png, '
            'reliability.png')),
    'asi ensemble': (
        Key('members', 'integer', 'parameter sets found'),
        Key('evaluations', 'integer', 'candidates tried'),
        Key('out', 'text', 'directory of their files'),
        Key('met', '[integer]', 'rows that each meets, of those that the calibration aims at'),
        Key('total', 'integer', 'those rows')),
    'asi import': (
        Key('bag', 'text', 'path of the bag'),
        Key('samples', 'integer', 'samples imported'),
        Key('duration_s', 'number', 'length of the recording'),
        Key('rate_hz', 'number', 'samples a second'),
        Key('signals', '[text]', 'signals that the bag holds')),
    'asi export': (
        Key('file', 'text', 'path of the file'),
        Key('samples', 'integer', 'rows'),
        Key('signals', '[text]', 'columns beside the time')),
}

_KINDS: Final[dict[str, Any]] = {
    'number': (int, float), 'integer': int, 'text': str, 'boolean': bool, 'object': dict}


def problems(document: Any, keys: tuple[Key, ...], where: str = '') -> list[str]:
    """Return what in a document is not as documented: missing, of another kind, or unknown."""
    found = [f'{where}{name} is not documented' for name in document
             if name not in {key.name for key in keys}]
    for key in keys:
        place = where + key.name
        if key.name not in document:
            found.append(f'{place} is missing')
            continue
        value, kind = document[key.name], key.kind.removesuffix('?')
        if value is None and key.kind.endswith('?'):
            continue
        inner = kind.strip('[]')
        values = value if kind.startswith('[') and isinstance(value, list) else [value]
        if kind.startswith('[') != isinstance(value, list) or not all(
                isinstance(each, _KINDS[inner])
                and (inner == 'boolean' or not isinstance(each, bool)) for each in values):
            found.append(f'{place} is not {key.kind}: {value!r}')
        elif key.keys:
            for number, each in enumerate(values):
                found += problems(each, key.keys, f'{place}[{number}].')
    return found


def page() -> str:
    """Return doc/json.md."""
    lines = ['# What `--json` prints', '',
             'One JSON document on stdout, nothing else; progress and errors go to stderr. '
             '`?`: or null. Exit status: 0 answered; 1 a check or a run failed; 2 the input or '
             'the call is wrong, with one line on stderr.', '',
             '*Made by `python -m asi_analysis.json_keys > doc/json.md`.*']
    for command, keys in DOCUMENTS.items():
        lines += ['', f'## `{command}`', '', '| key | kind | meaning |', '|---|---|---|']
        shared = keys is not ANALYZE and keys[-len(ANALYZE):] == ANALYZE
        lines += _rows(keys[:-len(ANALYZE)] if shared else keys)
        lines += ['', 'and the keys of `asi analyze`.'] if shared else []
    return '\n'.join(lines) + '\n'


def _rows(keys: tuple[Key, ...], prefix: str = '') -> list[str]:
    rows = []
    for key in keys:
        rows.append(f'| `{prefix}{key.name}` | {key.kind} | {key.meaning} |')
        if key.keys and key.keys is not ANALYZE:
            rows += _rows(key.keys, f'{prefix}{key.name}.')
    return rows


if __name__ == '__main__':
    print(page(), end='')
