"""Build the ament_python package; the same file serves pip and colcon."""

import xml.etree.ElementTree as ElementTree
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

package_name = 'asi_actuator'

setup(
    name=package_name,
    version=ElementTree.parse('package.xml').findtext('version'),
    packages=find_packages(include=['asi_common*', 'asi_actuator*', 'asi_controller*',
                                    'asi_analysis*', 'asi_examiner*']),
    package_data={'asi_common': ['py.typed', 'node/fastdds.xml', 'node/fastdds_localhost.xml'],
                  'asi_analysis': ['reporting/templates/*', '*/*/*.json', 'viewing/*.js',
                                   'py.typed'],
                  'asi_actuator': ['py.typed'],
                  'asi_controller': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/config', glob('config/*.*')),
        ('share/' + package_name + '/config/ensemble', glob('config/ensemble/*')),
        ('share/' + package_name + '/launch', glob('launch/*.py')),
    ],
    python_requires='>=3.11',
    # Lower bounds: the oldest versions that were tried together, by `make test-oldest`. Upper: the
    # first version after the newest tried that may break what is used. What is used of others that
    # they do not promise to keep is in test/test_private_parts.py, which names the version that
    # lacks it.
    install_requires=[
        'ros-jazzy-rclpy[fastrtps]',
        'ros-jazzy-common-interfaces',
        'numpy>=2.0,<3',         # StringDType
        'numba>=0.60,<1',
        'scipy>=1.13,<2',
        'pyyaml>=6.0.1,<7',
        'mcap>=1.5,<2',
        'python-can>=4.4,<5',
        'pyserial>=3.5,<4',
        'cantools>=39.4,<46',
        'zstandard>=0.22,<1',
        'lz4>=4.3,<5',
        'pint>=0.25,<1',         # units of imported recordings
        'rosbags>=0.11.9,<0.12',     # reads by apsw
        'backports.zstd>=1.0,<2',    # whose errors rosbags does not catch
        'pyarrow>=17,<27',
        'matplotlib>=3.9,<4',
        'jinja2>=3.1.4,<4',
        'typer>=0.26,<1',       # with its own copy of click
        'rich>=13.8,<16',
        'cma>=4.0,<5',
        'joblib>=1.4,<2',
    ],
    extras_require={     # their bounds were tried one by one
        'cluster': ['dask>=2024.8,<2027', 'distributed>=2024.8,<2027'],
        'pandas': ['pandas>=2.2.2,<4'],     # to_frame() of results and runs; with numpy 2
        'live': ['nicegui>=3.18,<4'],
        'view': ['rerun-sdk>=0.41,<1'],
        # Replays what asi gap --export writes; 3.5 has delays.
        'mujoco': ['mujoco>=3.5,<5'],
        # What `make bench` compares with, over what the tests need.
        'bench': ['mujoco', 'mcap-ros2-support'],
        # What `make docs` builds the documents with.
        'docs': ['sphinx>=8', 'myst-nb>=1.2', 'furo', 'sphinxcontrib-mermaid>=1.0'],
        'test': ['pytest', 'pytest-timeout', 'pytest-xdist>=3.5', 'hypothesis', 'control',
                 'colcon-common-extensions', 'ruff', 'mypy', 'import-linter>=2.0',
                 'types-PyYAML', 'dask', 'distributed', 'pandas>=2.2.2', 'nicegui>=3.18',
                 'playwright>=1.65'],   # the live page in Chromium, where there is one
    },
    zip_safe=True,
    maintainer='asi_actuator maintainers',
    maintainer_email='maintainers@example.com',
    description='Run, control, record and understand a force-controlled hydraulic joint '
                'actuator under ROS 2.',
    long_description=Path('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    keywords=['ros2', 'robotics', 'hydraulics', 'force control', 'limit cycle', 'sim-to-real'],
    classifiers=[
        'Development Status :: 4 - Beta',
        'Environment :: Console',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Scientific/Engineering',
        'Typing :: Typed',
    ],
    entry_points={
        'console_scripts': [
            'actuator = asi_actuator.executables:actuator',
            'can_actuator = asi_actuator.executables:can_actuator',
            'controller = asi_controller.executables:controller',
            'recorder = asi_analysis.bags.nodes.executables:recorder',
            'replay = asi_analysis.bags.nodes.executables:replay',
            'asi = asi_analysis.command:asi',
        ],
        # What the parameter `driver` of the actuator node takes; another package may add its own.
        'asi_actuator.drivers': [
            'simulated = asi_actuator.driver.simulated:SimulatedActuator',
            'can = asi_actuator.driver.can_bus:CanActuator',
            'replay = asi_analysis.bags.nodes.replay_driver:ReplayedActuator',
        ],
    },
)
