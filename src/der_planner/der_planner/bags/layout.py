"""The folder of a bag as rosbag2 lays it out: file names and ``metadata.yaml`` (version 9, Jazzy).

rosbag2 lists every file and topic of a bag in ``metadata.yaml``; ``ros2 bag info`` and ``ros2 bag
play`` read that first. Field names and their meaning: rosbag2's ``BagMetadata``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

FORMAT_VERSION = 9
DISTRIBUTION = "jazzy"
METADATA_FILE = "metadata.yaml"
RUN_KEY = "run"
"""Name of the MCAP metadata record, and of the custom-data entry, that holds the run's JSON."""

INFINITE = {"sec": 9223372036, "nsec": 854775807}


@dataclass(frozen=True)
class OfferedQos:
    """The QoS that a publisher offers, by rosbag2's words; durations are infinite."""

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "unknown"
    depth: int = 0

    def as_mapping(self) -> dict[str, Any]:
        """Return the profile as version 9 of the metadata writes it."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": dict(INFINITE),
            "lifespan": dict(INFINITE),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(INFINITE),
            "avoid_ros_namespace_conventions": False,
        }


@dataclass(frozen=True)
class TopicSpec:
    """One recorded topic.

    Attributes:
        name: fully qualified.
        type_name: ``package/msg/Name``.
        definition: ``ros2msg`` text with dependencies.
        type_hash: RIHS01.
        qos: one per publisher seen when the topic was added.
        latched: its last message is repeated at the start of every file of the bag.
    """

    name: str
    type_name: str
    definition: str
    type_hash: str = ""
    qos: tuple[OfferedQos, ...] = ()
    latched: bool = False

    def qos_yaml(self) -> str:
        """Return the offered profiles as the string that MCAP channels carry."""
        return dump_yaml([profile.as_mapping() for profile in self.qos]) if self.qos else ""


@dataclass
class FileSummary:
    """What one file of the bag holds; times in ns, both 0 without messages."""

    name: str
    message_count: int = 0
    first: int = 0
    last: int = 0

    def add(self, log_time: int) -> None:
        """Count a message."""
        self.first = log_time if self.message_count == 0 else min(self.first, log_time)
        self.last = max(self.last, log_time)
        self.message_count += 1


@dataclass
class BagSummary:
    """Everything that ``metadata.yaml`` says."""

    files: Sequence[FileSummary]
    topics: Sequence[TopicSpec]
    counts: Mapping[str, int]
    custom_data: Mapping[str, str] = field(default_factory=dict)

    def as_mapping(self) -> dict[str, Any]:
        """Return the document, without its root key."""
        filled = [entry for entry in self.files if entry.message_count]
        first = min((entry.first for entry in filled), default=0)
        last = max((entry.last for entry in filled), default=0)
        return {
            "version": FORMAT_VERSION,
            "storage_identifier": "mcap",
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": sum(entry.message_count for entry in self.files),
            "topics_with_message_count": [
                {"topic_metadata": _topic_mapping(spec), "message_count": self.counts[spec.name]}
                for spec in self.topics
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [entry.name for entry in self.files],
            "files": [
                {
                    "path": entry.name,
                    "starting_time": {"nanoseconds_since_epoch": entry.first},
                    "duration": {"nanoseconds": entry.last - entry.first},
                    "message_count": entry.message_count,
                }
                for entry in self.files
            ],
            "custom_data": dict(self.custom_data),
            "ros_distro": DISTRIBUTION,
        }

    def write(self, folder: Path) -> None:
        """Write ``metadata.yaml``, whole or not at all."""
        temporary = folder / f".{METADATA_FILE}.part"
        text = dump_yaml({"rosbag2_bagfile_information": self.as_mapping()})
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(folder / METADATA_FILE)


def _topic_mapping(spec: TopicSpec) -> dict[str, Any]:
    return {
        "name": spec.name,
        "type": spec.type_name,
        "serialization_format": "cdr",
        "offered_qos_profiles": [profile.as_mapping() for profile in spec.qos],
        "type_description_hash": spec.type_hash,
    }


def dump_yaml(value: object) -> str:
    """Return YAML in block style, keys in the order given, without aliases."""

    class Dumper(yaml.SafeDumper):
        def ignore_aliases(self, data: object) -> bool:  # noqa: ARG002 - yaml's signature
            return True

    return str(yaml.dump(value, Dumper=Dumper, sort_keys=False, default_flow_style=False)).strip()


def file_name(folder: Path, index: int) -> str:
    """Return the name of a bag's file by its number, as rosbag2 counts them."""
    return f"{folder.name}_{index}.mcap"
