"""Install `der_planner` as an ament_python package."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = "der_planner"
config = sorted(str(path) for path in Path("config").glob("*.*"))

setup(
    name=PACKAGE,
    version=ElementTree.parse("package.xml").findtext("version"),
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed", "data/*", "page/static/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", config),
    ],
    install_requires=[
        "setuptools",
        "numpy",
        "scipy",
        "numba",
        "PyYAML",
        "mcap",
        "rosbags",
        "matplotlib",
        "opencv-python-headless",
        "pyelastica",
        "piqp",
        "threadpoolctl",
    ],
    extras_require={"page": ["nicegui==3.18.*"], "test": ["pytest"]},
    zip_safe=False,
    maintainer="DER planner maintainers",
    maintainer_email="maintainers@example.org",
    description="Plans chamber pressures of a soft limb with a discrete elastic rod, records runs and evaluates them.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "planner = der_planner.nodes.entry:planner",
            "recorder = der_planner.nodes.entry:recorder",
            "limb_twin = der_planner.nodes.entry:limb_twin",
            "page = der_planner.nodes.entry:page",
        ],
    },
)
