"""Install `apriltag_tracker` as an ament_python package."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = "apriltag_tracker"
config = sorted(str(path) for path in Path("config").glob("*.*"))

setup(
    name=PACKAGE,
    version=ElementTree.parse("package.xml").findtext("version"),
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed", "data/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", config),
    ],
    install_requires=[
        "setuptools",
        "numpy",
        "numba",
        "scipy",
        "opencv-python-headless",
        "PyYAML",
        "matplotlib",
    ],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="DER planner maintainers",
    maintainer_email="maintainers@example.org",
    description="Finds the tip and the shape of a soft limb from the AprilTags on it.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "apriltag_tracker = apriltag_tracker.entry:apriltag_tracker",
            "synthetic_camera = apriltag_tracker.entry:synthetic_camera",
            "pose_tracker = apriltag_tracker.entry:pose_tracker",
            "synthetic_poses = apriltag_tracker.entry:synthetic_poses",
        ],
    },
)
