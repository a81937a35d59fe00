"""The shapes of the shipped URDF in Rerun, moving with a recording as in RViz."""

from collections.abc import Mapping
from typing import Any, Final
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_common.files import shipped
from asi_common.topics import FRAME

ROOT: Final = 'scene'
# Signal of a run that moves each joint of the URDF, m.
MOVES: Final = {'piston': 'position', 'valve': 'valve_position'}
# Length of the arrow of the largest force, m, and its height above the piston, which would hide
# it; largest number of positions that are kept.
ARROW_M: Final = 0.1
ABOVE_M: Final = 0.035
MOST: Final = 5000
ORANGE: Final = 0xd55e00ff


def log_scene(stream: rr.RecordingStream, time_name: str, run: Run) -> Any:
    """Log actuator, valve and load with their motion and the force; None if none is known."""
    known = {joint: run.signal(name) for joint, name in MOVES.items()
             if run.signals().get(name) is not None and run.unit(name) == 'm'}
    if not known:
        return None
    robot = ElementTree.parse(shipped('asi_actuator.urdf')).getroot()
    colours = {each.get('name'): _numbers(each.find('color'), 'rgba')
               for each in robot.iter('material') if each.find('color') is not None}
    paths = _paths(robot)
    every = slice(None, None, -(-len(run) // MOST))
    times = rr.TimeColumn(time_name, duration=run.time_s[every])
    for joint in robot.iter('joint'):
        path, start = paths[_child(joint)], _numbers(joint.find('origin'), 'xyz')
        moved = known.get(str(joint.get('name')))
        if moved is None:
            stream.log(path, rr.Transform3D(translation=start), static=True)
            continue
        metres = np.nan_to_num(moved[every])
        stream.send_columns(path, indexes=[times], columns=rr.Transform3D.columns(
            translation=start + np.outer(metres, _numbers(joint.find('axis'), 'xyz'))))
    for link in robot.iter('link'):
        for visual in link.iter('visual'):
            _shape(stream, f'{paths[str(link.get("name"))]}/shape', visual, colours)
    if run.force_n is not None and run.unit('force') == 'N':
        _force(stream, f'{paths[FRAME]}/force', times, run.force_n[every])
    return rrb.Spatial3DView(origin=ROOT, name='actuator, valve, load; the arrow is the force')


def _paths(robot: Element) -> dict[str, str]:
    """Return the path of each link: below its parent, so that it moves with it."""
    parents = {_child(joint): str(joint.find('parent').get('link'))  # type: ignore[union-attr]
               for joint in robot.iter('joint')}

    def path(link: str) -> str:
        return f'{path(parents[link]) if link in parents else ROOT}/{link}'
    return {str(link.get('name')): path(str(link.get('name'))) for link in robot.iter('link')}


def _child(joint: Element) -> str:
    return str(joint.find('child').get('link'))  # type: ignore[union-attr]


def _numbers(element: Element | None, name: str) -> Array:
    """Return the numbers of an attribute; zeros for an element that is not there."""
    text = '0 0 0' if element is None else element.get(name, '0 0 0')
    return np.array([float(each) for each in text.split()])


def _shape(stream: rr.RecordingStream, path: str, visual: Element,
           colours: Mapping[str | None, Array]) -> None:
    """Log the box or cylinder of a link."""
    origin, material = visual.find('origin'), visual.find('material')
    turned = Rotation.from_euler('xyz', _numbers(origin, 'rpy')).as_quat()
    stream.log(path, rr.Transform3D(translation=_numbers(origin, 'xyz'),
                                    quaternion=rr.Quaternion(xyzw=turned)), static=True)
    colour = None if material is None else [colours[material.get('name')]]
    for box in visual.iter('box'):
        stream.log(path, rr.Boxes3D(sizes=[_numbers(box, 'size')], colors=colour,
                                    fill_mode='solid'), static=True)
    for cylinder in visual.iter('cylinder'):
        stream.log(path, rr.Cylinders3D(
            lengths=[_numbers(cylinder, 'length')[0]], radii=[_numbers(cylinder, 'radius')[0]],
            colors=colour, fill_mode='solid'), static=True)


def _force(stream: rr.RecordingStream, path: str, times: Any, force_n: Array) -> None:
    """Log the force as an arrow along x."""
    shares = np.nan_to_num(force_n) / (np.nanmax(np.abs(force_n), initial=0.0) or 1.0)
    vectors = np.column_stack([ARROW_M * shares, 0.0 * shares, 0.0 * shares])
    stream.send_columns(path, indexes=[times], columns=rr.Arrows3D.columns(
        vectors=vectors, origins=[[0.0, 0.0, ABOVE_M]] * len(vectors),
        radii=[0.002] * len(vectors), colors=[ORANGE] * len(vectors)))
