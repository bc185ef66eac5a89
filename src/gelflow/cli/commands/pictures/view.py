"""`gelflow view SCENE`: a page in the browser with a scene that can be moved and played."""

import argparse
import sys

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_preset
from gelflow.cli.output import Output
from gelflow.errors import UsageError


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("scene", metavar="SCENE", help="name of a shipped scene, or a TOML, MJCF or URDF file")
    parser.add_argument("--num-envs", type=int, default=1, metavar="N", help="environments (default %(default)s)")
    parser.add_argument(
        "--env", type=int, default=0, metavar="N", help="environment that is shown (default %(default)s)"
    )
    parser.add_argument(
        "--port", type=int, default=8080, metavar="P", help="TCP port; 0: a free one (default %(default)s)"
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="H",
        help="address to serve on; other machines reach 0.0.0.0 and need the token in the printed address "
        "(default %(default)s)",
    )
    add_preset(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    if args.num_envs < 1:
        raise UsageError(f"--num-envs must be at least 1, got {args.num_envs}")
    from gelflow.sim.scene import load_scene
    from gelflow.sim.simulator import Simulator
    from gelflow.view.page import import_viser
    from gelflow.view.simulation_page import SimulationPage

    import_viser()
    sim = Simulator(load_scene(args.scene, preset=args.preset), num_envs=args.num_envs)
    with SimulationPage(sim, env=args.env, host=args.host, port=args.port, controls=True) as page:
        output = Output(args.json)
        output.text(f"open {page.url} in a browser; Ctrl-C ends")
        output.result({"url": page.url})
        sys.stdout.flush()  # it goes on
        try:
            page.run()
        except KeyboardInterrupt:
            return SUCCESS
    return SUCCESS
