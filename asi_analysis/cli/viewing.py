"""Commands that show a loop: live, view."""

import os
from pathlib import Path
from typing import Annotated

import typer

from asi_analysis.cli.options import Bag, command
from asi_analysis.errors import InputError
from asi_analysis.terminal import bar
from asi_common.signals import end_quietly


@command('live', 'asi live --simulate')
def live(
    simulate: Annotated[bool, typer.Option(
        '--simulate', help='Start a simulated actuator and a controller too')] = False,
    port: Annotated[int, typer.Option(help='Port of 127.0.0.1', min=1, max=65535)] = 8080,
    namespace: Annotated[str, typer.Option(help='Namespace of the loop, for example /left')] = '',
    browser: Annotated[bool, typer.Option(help='Open the page in the browser')] = True,
) -> None:
    """
    Show the running loop in the browser: signals, parameters, recording, analysis.

    It connects to the nodes of ROS_DOMAIN_ID and ends with Ctrl-C.
    """
    try:
        import nicegui  # noqa: F401
    except ImportError:
        raise InputError('asi live needs NiceGUI: pip install "asi_actuator[live]"') from None
    end_quietly()   # that is how it ends, also while it starts
    with bar() as progress:
        progress('starting', None)
        import rclpy

        from asi_analysis.viewing.page import serve
        from asi_common.node.executor import choose_transport
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    choose_transport(os.environ, rclpy.get_rmw_implementation_identifier())
    serve(port, namespace, simulate, browser)


@command('view', 'asi view runs/demo/lead_lag/bag')
def view(
    bag: Bag,
    out: Annotated[Path | None, typer.Option(
        help='Write this .rrd file for Rerun, and open no window')] = None,
) -> None:
    """Show a recording in the Rerun viewer: signals, valve loop, phase plane, spectrum."""
    try:
        import rerun  # noqa: F401
    except ImportError:
        raise InputError('asi view needs Rerun: pip install "asi_actuator[view]"') from None
    from asi_analysis.bags.bag import read_bag
    from asi_analysis.viewing.rerun_view import view as show_run
    if out is not None and out.suffix != '.rrd':
        raise InputError(f'--out {out}: it takes a name that ends in .rrd')
    with bar() as progress:
        progress('reading', None)
        print(show_run(read_bag(bag), out))
