"""Install `pressure_driver` as an ament_python package."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = "pressure_driver"
config = sorted(str(path) for path in Path("config").glob("*.*"))

setup(
    name=PACKAGE,
    version=ElementTree.parse("package.xml").findtext("version"),
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", config),
    ],
    install_requires=["setuptools", "cobs", "numpy", "pyserial"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="DER planner maintainers",
    maintainer_email="maintainers@example.org",
    description="Plays timed pressure setpoints on a valve board at 20 Hz, and vents the limb when anything fails.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "pressure_driver = pressure_driver.entry:pressure_driver",
            "board = pressure_driver.entry:board",
            "board_emulator = pressure_driver.entry:board_emulator",
            "topic_board = pressure_driver.entry:topic_board",
        ],
    },
)
