"""Writes datasets as LeRobot lays them out, v2.1 and v3.0, by pyarrow; no code of LeRobot."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow.parquet import ParquetWriter, write_table

NAMES = ('shoulder_pan.pos', 'elbow_flex.pos')


def write_dataset(folder: Path, version: str = 'v3.0', rows: Sequence[int] = (120, 90, 150),
                  names: Any = NAMES, fps: int = 30, width: int = 2) -> Path:
    """Write so many rows an episode: joint k of episode e is at e + k + sin of its time."""
    one_file = version.startswith('v3')
    path = ('data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet' if one_file else
            'data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet')
    vector = {'dtype': 'float32', 'shape': [width], 'names': names}
    scalar = {'shape': [1], 'names': None}
    info = {
        'codebase_version': version, 'robot_type': 'so100_follower', 'fps': fps,
        'total_episodes': len(rows), 'total_frames': int(sum(rows)), 'total_tasks': 1,
        'chunks_size': 1000, 'splits': {'train': f'0:{len(rows)}'}, 'data_path': path,
        'video_path': 'videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4',
        'features': {
            'action': vector, 'observation.state': vector,
            'observation.images.front': {'dtype': 'video', 'shape': [480, 640, 3],
                                         'names': ['height', 'width', 'channels']},
            'timestamp': {'dtype': 'float32', **scalar},
            'next.done': {'dtype': 'bool', **scalar},
            **{name: {'dtype': 'int64', **scalar} for name in (
                'frame_index', 'episode_index', 'index', 'task_index')}}}
    (folder / 'meta').mkdir(parents=True)
    (folder / 'meta/info.json').write_text(json.dumps(info))
    tables = [_episode(e, count, fps, width, sum(rows[:e])) for e, count in enumerate(rows)]
    (folder / 'data/chunk-000').mkdir(parents=True)
    if one_file:   # the last one in a file of its own, as after a larger one
        with ParquetWriter(folder / 'data/chunk-000/file-000.parquet', tables[0].schema,
                           write_page_checksum=True) as writer:
            for table in tables[:-1] or tables:
                writer.write_table(table)
        if tables[:-1]:
            write_table(tables[-1], folder / 'data/chunk-000/file-001.parquet',
                        write_page_checksum=True)
    else:
        for e, table in enumerate(tables):
            write_table(table, folder / f'data/chunk-000/episode_{e:06d}.parquet',
                        write_page_checksum=True)
    return folder


def _episode(number: int, count: int, fps: int, width: int, first: int) -> pa.Table:
    time = np.arange(count) / fps
    state = number + np.arange(width) + np.sin(time)[:, None]
    listed = pa.list_(pa.float32(), width)

    def vectors(values: np.ndarray) -> pa.Array:
        return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel(), pa.float32()), width
                                                 ).cast(listed)

    return pa.table({
        'action': vectors(state + 0.1), 'observation.state': vectors(state),
        'timestamp': pa.array(time, pa.float32()),
        'next.done': pa.array(np.arange(count) == count - 1),
        'frame_index': pa.array(np.arange(count)),
        'episode_index': pa.array(np.full(count, number)),
        'index': pa.array(first + np.arange(count)),
        'task_index': pa.array(np.zeros(count, int))})
