"""
Launch the actuator and its controller; optionally a recorder, and RViz.

ros2 launch asi_actuator asi_actuator.launch.py mode:=realtime reference:=sine record:=run1

An argument that is given sets its parameter; otherwise the parameter files apply. Without files,
compensator and gain the controller has the settings of config/quiet.yaml.
"""

from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, Shutdown
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

NODES = ('actuator', 'controller', 'recorder')
YES_NO = {'true': True, 'false': False}
# Launch argument: (parameter, type, nodes, description).
PARAMETERS = {
    'mode': ('mode', str, NODES[:2], 'lockstep or realtime'),
    'rate_hz': ('rate_hz', float, NODES[:2],
                'control rate; 0: 5000 in lock-step, 1000 in real time'),
    'real_time_factor': ('real_time_factor', float, ('actuator',),
                         'speed of lock-step; 1: at most that of a clock, 0: as fast as it can'),
    'duration': ('duration', float, ('actuator',), 'length of the run in s; 0: no end'),
    'driver': ('driver', str, ('actuator',), 'simulated, can, replay or another installed one'),
    'compensator': ('compensator', str, ('controller',),
                    'proportional, lead_lag, lead2, lead4 or custom; if neither this nor gain nor '
                    'params_file is given, config/quiet.yaml'),
    'gain': ('gain', float, ('controller',), 'gain of the compensator; 0: its own'),
    'reference': ('reference.shape', str, ('controller',),
                  'topic, or a signal of the controller: step, ramp, sine, chirp …'),
    'record': ('output', str, ('recorder',), 'directory of the bag; empty: nothing is recorded'),
    'use_sim_time': ('use_sim_time', bool, NODES, 'true: time stamps from the topic clock'),
}
OTHERS = (
    ('namespace', '', 'namespace of all nodes'),
    ('log_level', 'info', 'debug, info, warn, error or fatal, of all nodes; debug leaves out '
     'the lines of rcl, which writes some for each message'),
    ('params_file', '', 'parameter files for all nodes, separated by commas; the last one wins; '
     'a name that is no file here is that of one in config'),
    ('rviz', 'false', 'true: show the actuator in RViz'),
)
# rcl writes several lines for each message; behind them a Ctrl-C of launch took 5 s.
QUIET_RCL = {'debug': ['--log-level', 'rcl:=info']}
# Frames of the actuator per second of simulated time, for a smooth picture also in slow lock-step.
FRAMES_HZ = 100.0
# Time for the recorder to finish its bag after Ctrl-C, s, before SIGTERM, and then SIGKILL.
FINISH_S = '30'


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value='', description=text)
          for name, (*_, text) in PARAMETERS.items()),
        *(DeclareLaunchArgument(name, default_value=default, description=text)
          for name, default, text in OTHERS),
        OpaqueFunction(function=_started)])


def _started(context: Any) -> list[Any]:
    """Return the nodes for the arguments."""
    given = context.launch_configurations
    values = {node: _parameters(given, node) for node in NODES}

    def node(executable: str, **options: Any) -> Node:
        return Node(package='asi_actuator', executable=executable, namespace=given['namespace'],
                    parameters=values[executable], remappings=[('/clock', 'clock')],
                    ros_arguments=['--log-level', given['log_level'],
                                   *QUIET_RCL.get(given['log_level'].lower(), [])], **options)

    nodes = [node('actuator', on_exit=_run_ended),
             node('controller', on_exit=_ended)]
    if given['record']:
        nodes.append(node('recorder', on_exit=_ended, sigterm_timeout=FINISH_S,
                          sigkill_timeout=FINISH_S))
    return _misspelt(given) + nodes + _scene(given)


def _misspelt(given: dict[str, str]) -> list[Any]:
    """Return what to say of arguments like ours, which launch ignores: they may be of others."""
    ours = [*PARAMETERS, *(name for name, *_ in OTHERS)]
    return [LogInfo(msg=f'asi_actuator.launch.py has no argument {name}: is {like[0]} meant?')
            for name in given if name not in ours and (like := get_close_matches(name, ours, 1))]


def _parameters(given: dict[str, str], node: str) -> list[Any]:
    """Return the parameter files of a node, followed by the parameters of the arguments."""
    values: dict[str, Any] = {
        parameter: ParameterValue(_value(name, kind, given[name]), value_type=kind)
        for name, (parameter, kind, nodes, _) in PARAMETERS.items()
        if given[name] and node in nodes}
    if given['record'] and node != 'recorder':
        values['await_recorder'] = True
    files = [_file(file) for file in given['params_file'].split(',') if file]
    if node == 'controller' and not (files or given['compensator'] or given['gain']):
        files = [_file('quiet.yaml')]
    return [*files, values] if values else files


def _value(name: str, kind: type, text: str) -> Any:
    """Return an argument as its type. Raises ValueError with its name."""
    try:
        return YES_NO[text.lower()] if kind is bool else kind(text)
    except (KeyError, ValueError):
        wanted = 'true or false' if kind is bool else 'a number'
        raise ValueError(f'{name}:={text} is not allowed: it takes {wanted}') from None


def _file(name: str) -> str:
    """Return the path of a parameter file. launch_ros would start a node without it."""
    for path in (Path(name), _config() / name):
        if path.is_file():
            return str(path)
    raise ValueError(f'params_file:={name}: there is no such file, here or in {_config()}')


def _config() -> Path:
    return Path(get_package_share_directory('asi_actuator')) / 'config'


def _run_ended(event: Any, context: Any) -> list[Any]:
    """Shut down at the end of the run. Raises RuntimeError if it has failed."""
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(f'the actuator has ended with exit status {event.returncode}')
    return [Shutdown(reason='the run has ended')]


def _ended(event: Any, context: Any) -> list[Any]:
    """
    Raise RuntimeError if a node could not start: the others would wait for it.

    launch then ends them all, with exit status 1; after a Shutdown its own would be 0.
    """
    if event.returncode == 2 and not context.is_shutdown:
        raise RuntimeError(f'the {event.action.node_executable} could not start')
    return []


def _scene(given: dict[str, str]) -> list[Any]:
    """Return RViz and the publisher of the actuator's frames, where they are installed."""
    if not _value('rviz', bool, given['rviz']):
        return []
    config = _config()
    urdf = (config / 'asi_actuator.urdf').read_text()
    scene: list[Any] = []
    names = ('tf', 'tf_static', 'clock')
    for package, parameters, arguments in (
            ('robot_state_publisher', {'robot_description': ParameterValue(urdf, value_type=str),
                                       'publish_frequency': FRAMES_HZ}, []),
            ('rviz2', {}, ['-d', str(config / 'asi_actuator.rviz')])):
        try:
            get_package_share_directory(package)
        except PackageNotFoundError:
            scene.append(LogInfo(msg=f'rviz:=true needs {package}, which is not installed'))
            continue
        if given['use_sim_time']:
            parameters['use_sim_time'] = _value('use_sim_time', bool, given['use_sim_time'])
        scene.append(Node(package=package, executable=package, namespace=given['namespace'],
                          parameters=[parameters], arguments=arguments,
                          remappings=[(f'/{name}', name) for name in names]))
    return scene
