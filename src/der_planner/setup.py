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
    package_data={
        PACKAGE: ["py.typed", "data/*", "page/static/*", "results/*.html", "studies/shipped/*"]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", config),
    ],
    # What rod, model, identification's fit and planner import. The workspace's own requirements/
    # hold all of it; who installs this package alone takes extras for the rest.
    install_requires=["numpy", "scipy", "numba", "PyYAML", "piqp", "threadpoolctl"],
    extras_require={
        "twin": ["pyelastica"],
        "recording": ["mcap", "rosbags"],
        "evaluation": ["mcap", "rosbags", "matplotlib", "opencv-python-headless"],
        "studies": ["pyelastica", "distributed", "matplotlib"],
        "page": ["nicegui==3.18.*", "opencv-python-headless", "psutil==7.2.*"],
        "test": ["pytest"],
    },
    zip_safe=False,
    maintainer="DER planner maintainers",
    maintainer_email="maintainers@example.org",
    description="Plans chamber pressures of a soft limb with a discrete elastic rod, records runs and evaluates them.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "planner = der_planner.nodes:run_planner",
            "recorder = der_planner.nodes:run_recorder",
            "limb_twin = der_planner.nodes:run_limb_twin",
            "page = der_planner.nodes:run_page",
        ],
    },
)
