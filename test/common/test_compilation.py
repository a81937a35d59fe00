"""A node says when it begins to compile."""

import subprocess
import sys

CODE = """
import numba
from asi_common.node.compilation import tell_of_compilation
tell_of_compilation('node')
for _ in range(2):
    assert numba.njit(lambda x: x + 1.0)(1.0) == 2.0
"""


def test_compilation_is_told_once(ros_environment) -> None:
    result = subprocess.run([sys.executable, '-c', CODE], capture_output=True, text=True,
                            env=ros_environment)
    assert result.returncode == 0, result.stderr
    assert (result.stdout + result.stderr).count('[node]: compiling') == 1
