"""``ros2 service``: the services of the graph."""

from __future__ import annotations

import argparse
import time

from ros2_verbs.cli import CommandError, add_verb, add_verbs
from ros2_verbs.filling import Filler, values_of
from ros2_verbs.messages import interface
from ros2_verbs.session import Session, add_session_arguments, is_hidden, print_names, print_types


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verbs of ``ros2 service`` and their arguments."""
    verbs = add_verbs(parser, "service")
    lister = add_verb(verbs, "list", "Output a list of available services", _list)
    add_session_arguments(lister)
    lister.add_argument(
        "-t", "--show-types", action="store_true", help="Additionally show the service type"
    )
    lister.add_argument(
        "-c", "--count-services", action="store_true", help="Only display the number of services"
    )
    lister.add_argument(
        "--include-hidden-services", action="store_true", help="Consider hidden services as well"
    )
    kind = add_verb(verbs, "type", "Output a service's type", _type)
    add_session_arguments(kind)
    kind.add_argument("service_name", help="Name of the ROS service to get type")
    call = add_verb(verbs, "call", "Call a service", _call)
    call.add_argument("service_name", help="Name of the ROS service to call to")
    call.add_argument("service_type", help="Type of the ROS service (e.g. 'std_srvs/srv/Empty')")
    call.add_argument(
        "values",
        nargs="?",
        default="{}",
        help="Values to fill the service request with in YAML format (e.g. '{a: 1, b: 2}')",
    )
    call.add_argument(
        "-r", "--rate", metavar="N", type=float, help="Repeat the call at a specific rate in Hz"
    )


def _list(options: argparse.Namespace) -> None:
    with Session(options) as session:
        session.discover()
        found = {
            name: types
            for name, types in session.services().items()
            if options.include_hidden_services or not is_hidden(name)
        }
    if options.count_services:
        print(len(found))
        return
    print_names(found, options.show_types)


def _type(options: argparse.Namespace) -> int:
    return print_types(options, options.service_name, Session.services)


def _call(options: argparse.Namespace) -> None:
    if options.rate is not None and options.rate <= 0:
        raise CommandError("rate must be greater than zero")
    kind = interface(options.service_type, "srv")
    values = values_of(options.values)
    request = Filler(kind.Request(), values).message
    with Session(options) as session:
        client = session.node.create_client(kind, options.service_name)
        if not client.wait_for_service(timeout_sec=0.2):
            print("waiting for service to become available...")
            client.wait_for_service()
        while True:
            started = time.monotonic()
            print(f"requester: making request: {request!r}\n")
            print(f"response:\n{session.answer(client, request)!r}\n")
            if options.rate is None:
                return
            time.sleep(max(0.0, started + 1.0 / options.rate - time.monotonic()))
