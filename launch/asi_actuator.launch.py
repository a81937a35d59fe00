"""
The actuator and its controller, and a recorder if it is wanted.

ros2 launch asi_actuator asi_actuator.launch.py mode:=realtime record:=run1
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

CONFIG = Path(get_package_share_directory('asi_actuator')) / 'config'

ARGUMENTS = (
    ('mode', 'lockstep', 'lockstep or realtime'),
    ('rate_hz', '0.0', 'control rate; 0: 5000 in lock-step, 1000 in real time'),
    ('duration', '0.0', 'length of the run in s; 0: no end'),
    ('actuator_config', str(CONFIG / 'actuator.yaml'), 'parameter file of the actuator'),
    ('controller_config', str(CONFIG / 'controller.yaml'), 'parameter file of the controller'),
    ('record', '', 'directory of the bag; empty: nothing is recorded'),
)


def generate_launch_description() -> LaunchDescription:
    """Return what to start."""
    record = LaunchConfiguration('record')
    recorded = NotEqualsSubstitution(record, '')
    loop = {
        'mode': LaunchConfiguration('mode'),
        'rate_hz': ParameterValue(LaunchConfiguration('rate_hz'), value_type=float),
        'await_recorder': ParameterValue(recorded, value_type=bool),
    }
    duration = {'duration': ParameterValue(LaunchConfiguration('duration'), value_type=float)}
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=text)
          for name, default, text in ARGUMENTS),
        Node(package='asi_actuator', executable='actuator',
             parameters=[LaunchConfiguration('actuator_config'), loop | duration],
             on_exit=Shutdown(reason='the run has ended')),
        Node(package='asi_actuator', executable='controller',
             parameters=[LaunchConfiguration('controller_config'), loop]),
        Node(package='asi_actuator', executable='recorder', parameters=[{'output': record}],
             condition=IfCondition(recorded)),
    ])
