"""What is shipped for viewers fits the topics, joints and frames that the nodes publish."""

import json
import re
import shlex
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from conftest import Listener, NodeProcess, wait_until
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from asi_common.node import messages as wire
from asi_common.node.topics import message_class
from asi_common.topics import FRAME, JOINTS, TOPICS

CONFIG = Path(__file__).parents[1] / 'config'
# What Lichtblick reads of a layout (lichtblick-suite/lichtblick, 66adecb: PlotConfig and PlotPath
# of panels/Plot/utils/config.ts, DiagnosticSummaryConfig, LayoutData): keys, those it needs, and
# the values of those that are a choice.
PLOT = {'paths', 'minXValue', 'maxXValue', 'minYValue', 'maxYValue', 'showLegend',
        'legendDisplay', 'showPlotValuesInLegend', 'showXAxisLabels', 'showYAxisLabels',
        'isSynced', 'xAxisVal', 'xAxisPath', 'xAxisLabel', 'yAxisLabel', 'followingViewWidth',
        'sidebarDimension', 'lichtblickPanelTitle', 'foxglovePanelTitle'}
PATH = {'value', 'enabled', 'color', 'label', 'timestampMethod', 'showLine', 'lineSize'}
SUMMARY = {'minLevel', 'pinnedIds', 'topicToRender', 'hardwareIdFilter', 'sortByLevel',
           'secondsUntilStale'}
LAYOUT = {'configById', 'layout', 'globalVariables', 'playbackConfig', 'userNodes', 'version'}
CHOICES = {'legendDisplay': {'floating', 'top', 'left', 'none'},
           'xAxisVal': {'timestamp', 'index', 'custom', 'currentCustom'},
           'timestampMethod': {'receiveTime', 'headerStamp'}}
# What PlotJuggler reads (facontidavide/PlotJuggler, ddcbd05: xmlLoadState of mainwindow.cpp,
# tabbedplotwidget.cpp, plot_docker.cpp and plotwidget.cpp): parent and attributes of each element.
PLOTJUGGLER = {
    'tabbed_widget': ('root', {'name', 'parent'}),
    'Tab': ('tabbed_widget', {'tab_name', 'containers'}),
    'Container': ('Tab', set()), 'DockSplitter': ('Container', {'orientation', 'sizes', 'count'}),
    'DockArea': ('DockSplitter', {'name'}), 'plot': ('DockArea', {'mode', 'style'}),
    'curve': ('plot', {'name', 'color'}), 'currentTabIndex': ('tabbed_widget', {'index'}),
    'use_relative_time_offset': ('root', {'enabled'})}
# What RViz reads (ros2/rviz, 591594e of jazzy): the properties of each plugin
# (robot_model_display.cpp, tf_display.cpp, wrench_display.cpp, orbit_view_controller.cpp), of a
# topic (qos_profile_property.cpp, message_filter_display.hpp).
DISPLAY = {'Class', 'Name', 'Enabled'}
RVIZ = {
    'rviz_default_plugins/RobotModel': DISPLAY | {
        'Visual Enabled', 'Collision Enabled', 'Update Interval', 'Alpha', 'Description Source',
        'Description File', 'Description Topic', 'TF Prefix'},
    'rviz_default_plugins/TF': DISPLAY | {
        'Show Names', 'Show Axes', 'Show Arrows', 'Marker Scale', 'Update Interval',
        'Frame Timeout'},
    'rviz_default_plugins/Wrench': DISPLAY | {
        'Topic', 'Accept NaN Values', 'Force Color', 'Torque Color', 'Alpha', 'Force Arrow Scale',
        'Torque Arrow Scale', 'Arrow Width', 'History Length'},
    'rviz_default_plugins/Orbit': {
        'Class', 'Name', 'Distance', 'Focal Point', 'Yaw', 'Pitch', 'Target Frame'},
    'rviz_default_plugins/MoveCamera': {'Class'}, 'rviz_common/Displays': {'Class', 'Name'}}
RVIZ_TOPIC = {
    'Value': None, 'Depth': None, 'Filter size': None,
    'History Policy': {'System Default', 'Keep Last', 'Keep All'},
    'Reliability Policy': {'System Default', 'Reliable', 'Best Effort'},
    'Durability Policy': {'System Default', 'Transient Local', 'Volatile'}}
STYLES = {'Lines', 'Dots', 'LinesAndDots', 'Sticks', 'Steps', 'StepsInv'}


def paths(file: str) -> list[str]:
    """Return the signals that a layout shows, as topic/field/field."""
    text = (CONFIG / file).read_text()
    if file.endswith('.json'):
        panels = json.loads(text)['configById'].values()
        return [re.sub(r'\.', '/', path['value']) for panel in panels
                for path in panel.get('paths', [])]
    return [curve.get('name', '') for curve in ElementTree.fromstring(text).iter('curve')]


@pytest.mark.parametrize('file', ['foxglove_layout.json', 'plotjuggler_layout.xml'])
def test_a_layout_shows_numbers_of_our_topics(file: str) -> None:
    shown = paths(file)
    assert {path.split('/')[1] for path in shown} == {
        'force', 'force_reference', 'valve_command', 'valve_position', 'velocity'}
    for path in shown:
        _, topic, *fields = path.split('/')
        value: Any = message_class(TOPICS[topic].type)()
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, float)


def test_foxglove_shows_each_panel_of_its_layout_once() -> None:
    layout = json.loads((CONFIG / 'foxglove_layout.json').read_text())

    def panels(tree: Any) -> list[str]:
        return [tree] if isinstance(tree, str) else panels(tree['first']) + panels(tree['second'])

    assert sorted(panels(layout['layout'])) == sorted(layout['configById'])
    # The key of a title in Foxglove, and in Lichtblick.
    titles = [{each.get(f'{viewer}PanelTitle') for viewer in ('foxglove', 'lichtblick')}
              for name, each in layout['configById'].items() if name.startswith('Plot!')]
    assert all(len(title) == 1 and None not in title for title in titles)
    assert layout['configById']['DiagnosticSummary!health']['topicToRender'] in TOPICS


def test_lichtblick_knows_every_key_of_the_layout() -> None:
    layout = json.loads((CONFIG / 'foxglove_layout.json').read_text())
    assert {'configById', 'globalVariables', 'playbackConfig'} <= layout.keys() <= LAYOUT
    for name, panel in layout['configById'].items():
        known = {'Plot': PLOT, 'DiagnosticSummary': SUMMARY}[name.partition('!')[0]]
        assert panel.keys() <= known
        for each in (panel, *panel.get('paths', [])):
            assert all(each[key] in values for key, values in CHOICES.items() if key in each)
        for path in panel.get('paths', []):
            assert {'value', 'enabled', 'timestampMethod'} <= path.keys() <= PATH


def test_plotjuggler_reads_every_element_of_the_layout() -> None:
    root = ElementTree.parse(CONFIG / 'plotjuggler_layout.xml').getroot()
    for parent in root.iter():
        for child in parent:
            expected, attributes = PLOTJUGGLER[child.tag]
            assert (parent.tag, set(child.keys())) == (expected, attributes)
    window, = root.iter('tabbed_widget')
    assert (window.get('name'), window.get('parent')) == ('Main Window', 'main_window')
    for splitter in root.iter('DockSplitter'):
        sizes = [float(size) for size in splitter.get('sizes', '').split(';')]
        assert splitter.get('orientation') in ('-', '|') and sum(sizes) == 1.0
        assert int(splitter.get('count', '')) == len(sizes) == len(splitter)
    assert all(plot.get('mode') == 'TimeSeries' and plot.get('style') in STYLES
               for plot in root.iter('plot'))


def test_the_joints_and_the_frame_of_the_topics_are_in_one_tree() -> None:
    robot = ElementTree.parse(CONFIG / 'asi_actuator.urdf').getroot()
    parents = {child.get('link'): parent.get('link') for joint in robot.iter('joint')
               for child in joint.iter('child') for parent in joint.iter('parent')}
    links = {link.get('name') for link in robot.iter('link')}
    assert {joint.get('name') for joint in robot.iter('joint')
            if joint.get('type') == 'prismatic'} == set(JOINTS)
    assert FRAME in parents and set(parents) | set(parents.values()) == links
    assert links - set(parents) == {'actuator'}
    rviz = yaml.safe_load((CONFIG / 'asi_actuator.rviz').read_text())['Visualization Manager']
    assert rviz['Global Options']['Fixed Frame'] == 'actuator'
    topics = [display['Topic']['Value'] for display in rviz['Displays'] if 'Topic' in display]
    assert topics == ['force'] and set(topics) <= set(TOPICS)


def test_rviz_knows_every_property_of_its_configuration() -> None:
    given = yaml.safe_load((CONFIG / 'asi_actuator.rviz').read_text())
    manager = given['Visualization Manager']
    assert given.keys() == {'Panels', 'Visualization Manager'}
    assert manager.keys() == {'Class', 'Displays', 'Global Options', 'Tools', 'Views'}
    for plugin in (*given['Panels'], *manager['Displays'], *manager['Tools'],
                   manager['Views']['Current']):
        assert plugin.keys() <= RVIZ[plugin['Class']]
        for topic in (value for name, value in plugin.items() if name.endswith('Topic')):
            assert topic.keys() <= RVIZ_TOPIC.keys()
            assert all(topic[key] in known for key, known in RVIZ_TOPIC.items()
                       if known and key in topic)


def test_the_analyzers_take_every_status_of_the_nodes(
        start_node: Callable[..., NodeProcess], ros_node: Any) -> None:
    """As diagnostic_aggregator does: `contains` is part of the name, `num_items` their number."""
    given = yaml.safe_load((CONFIG / 'diagnostic_aggregator.yaml').read_text())['analyzers']
    analyzers = {name: each for name, each in given['ros__parameters'].items()
                 if isinstance(each, dict)}
    heard = Listener(ros_node, DiagnosticArray, '/diagnostics')
    start_node('asi_actuator.actuator_node', mode='realtime', rate_hz=200.0)
    start_node('asi_controller.controller_node', mode='realtime', rate_hz=200.0)
    wait_until(lambda: {'asi_actuator', 'asi_controller'} <= {
        status.hardware_id for message in heard.messages for status in message.status}, 'both')
    heard.wait(5)
    names = {status.name for message in heard.messages for status in message.status}
    taken = {name: [status for status in names if any(part in status for part in each['contains'])]
             for name, each in analyzers.items()}
    assert {name: len(found) for name, found in taken.items()} == {
        name: each['num_items'] for name, each in analyzers.items()}
    assert set().union(*taken.values()) == names
    assert all(status.startswith(tuple(analyzers[name]['remove_prefix']))
               for name, found in taken.items() for status in found)


def test_a_command_of_ros2_control_arrives_as_the_desired_force() -> None:
    """
    The messages of joint_state_topic_hardware_interface, through the expression for topic_tools.

    The plugin names all joints, and appends an effort for those alone that have the interface.
    """
    system = ElementTree.parse(CONFIG / 'ros2_control.xacro').getroot()
    given = {param.get('name'): param.text for param in system.iter('param')}
    text = (CONFIG / 'ros2_control.yaml').read_text()
    command, = (line for line in text.splitlines() if 'ros2 run topic_tools transform' in line)
    source, target, type_, expression, _, *modules = shlex.split(command)[5:]
    assert given == {'joint_states_topic': '/joint_states', 'joint_commands_topic': source,
                     'trigger_joint_command_threshold': '-1'}
    assert TOPICS[target.strip('/')].type == type_
    joints = {joint.get('name'): {each.get('name') for each in joint.iter('command_interface')}
              for joint in system.iter('joint')}
    assert set(joints) == set(JOINTS)
    controllers = yaml.safe_load(text)
    commanded = controllers['force']['ros__parameters']
    sent = JointState(name=list(joints))
    sent.header.stamp.sec = 7
    for name, interfaces in joints.items():
        if interfaces:
            assert commanded == {'joints': [name], 'interface_name': min(interfaces)}
            sent.effort.append(123.0)
    received = eval(expression, {module: import_module(module) for module in modules}
                    | {'m': sent})
    assert wire.force(serialize_message(received)) == (7_000_000_000, 123.0)
    # What the plugin reads: every joint has all three numbers.
    state = deserialize_message(wire.state(0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)[0], JointState)
    assert set(joints) <= set(state.name)
    assert {len(state.position), len(state.velocity), len(state.effort)} == {len(state.name)}
