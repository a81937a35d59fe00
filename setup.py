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
                  'asi_analysis': ['reporting/templates/*', '*/*/*.json', 'py.typed'],
                  'asi_actuator': ['py.typed'],
                  'asi_controller': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/config', glob('config/*.*')),
        ('share/' + package_name + '/config/ensemble', glob('config/ensemble/*')),
        ('share/' + package_name + '/launch', glob('launch/*')),
    ],
    python_requires='>=3.11',
    install_requires=[
        'ros-jazzy-rclpy[fastrtps]',
        'ros-jazzy-common-interfaces',
        'numpy>=2.0',         # StringDType
        'numba',
        'scipy',
        'pyyaml',
        'mcap',
        'python-can',
        'pyserial',
        'cantools',
        'zstandard',
        'lz4>=4.0',
        'pint>=0.25',            # units of imported recordings
        'rosbags',
        'pyarrow',
        'matplotlib>=3.7',   # legends outside the axes
        'jinja2',
        'typer>=0.19',       # Literal as the type of an option
        'rich',
        'cma',
        'joblib',
    ],
    extras_require={
        'cluster': ['dask', 'distributed'],
        'pandas': ['pandas>=2.0'],   # to_frame() of results and runs
        'live': ['nicegui>=3.18'],
        'view': ['rerun-sdk>=0.41'],
        # What `make bench` compares with, over what the tests need.
        'bench': ['mujoco', 'mcap-ros2-support'],
        # What `make docs` builds the documents with.
        'docs': ['sphinx>=8', 'myst-nb>=1.2', 'furo', 'sphinxcontrib-mermaid>=1.0'],
        'test': ['pytest', 'pytest-timeout', 'hypothesis', 'control', 'colcon-common-extensions',
                 'ruff', 'mypy', 'import-linter>=2.0', 'types-PyYAML', 'dask', 'distributed',
                 'pandas>=2.0', 'nicegui>=3.18'],
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
            'asi = asi_analysis.cli:main',
        ],
        # What the parameter `driver` of the actuator node takes; another package may add its own.
        'asi_actuator.drivers': [
            'simulated = asi_actuator.driver.simulated:SimulatedActuator',
            'can = asi_actuator.driver.can_bus:CanActuator',
            'replay = asi_analysis.bags.nodes.replay_driver:ReplayedActuator',
        ],
    },
)
