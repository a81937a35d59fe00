"""Two pseudo-terminals that are linked: what is written to one is read from the other."""

import os
import select
import threading
import tty
from collections.abc import Callable


def unchanged(data: bytes) -> bytes:
    return data


class LinkedTerminals:
    """A thread carries bytes between `first` and `second` (paths) until close()."""

    def __init__(self, to_first: Callable[[bytes], bytes] = unchanged,
                 to_second: Callable[[bytes], bytes] = unchanged):
        """to_first and to_second return what arrives of what was written at the other end."""
        (master_1, slave_1), (master_2, slave_2) = os.openpty(), os.openpty()
        # The slaves stay open here, so that an end may be closed and opened again.
        self._files = (master_1, master_2, slave_1, slave_2)
        for slave in (slave_1, slave_2):
            tty.setraw(slave)
        for master in (master_1, master_2):
            os.set_blocking(master, False)
        self.first, self.second = os.ttyname(slave_1), os.ttyname(slave_2)
        self._ways = {master_1: (master_2, to_second), master_2: (master_1, to_first)}
        self._stop_read, self._stop_write = os.pipe()
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Take the link away: reading or writing at its ends fails from now on."""
        os.write(self._stop_write, b'.')
        self._thread.join()
        for file in (*self._files, self._stop_read, self._stop_write):
            os.close(file)

    def _carry(self) -> None:
        while True:
            ready = select.select([*self._ways, self._stop_read], [], [])[0]
            if self._stop_read in ready:
                return
            for master in ready:
                other, change = self._ways[master]
                data = change(os.read(master, 4096))
                try:
                    os.write(other, data)
                except BlockingIOError:
                    pass  # the buffer is full, as nobody reads: lost, as on a bus
