"""Versions of the software, for the metadata of bags and reports."""

import importlib.metadata
import platform


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on, by name."""
    names = ('asi_actuator', 'numpy', 'numba', 'scipy', 'ros-jazzy-rclpy', 'rosbags')
    found = {'python': platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
