"""All metadata of the package: pip and colcon both read it from here (a [project] table would break colcon)."""
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

HERE = Path(__file__).resolve().parent  # colcon --symlink-install runs a link to this file
PACKAGE = ElementTree.parse(HERE / 'package.xml').getroot()
NAME = PACKAGE.findtext('name')
SHARE = f'share/{NAME}'


def shared(folder: str) -> tuple[str, list[str]]:
    """The files of one folder, for share/line_slam_ros/<folder>."""
    return f'{SHARE}/{folder}', sorted(str(p.relative_to(HERE)) for p in (HERE / folder).iterdir() if p.is_file())


setup(
    name=NAME,
    version=PACKAGE.findtext('version'),
    description=PACKAGE.findtext('description'),
    long_description=(HERE / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    maintainer=PACKAGE.findtext('maintainer'),
    maintainer_email=PACKAGE.find('maintainer').get('email'),
    license=PACKAGE.findtext('license'),
    classifiers=[
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Topic :: Scientific/Engineering :: Image Processing',
    ],
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*', 'msg_adapters', 'msg_adapters.*']),
    install_requires=[
        'numpy>=1.26,<3',
        'opencv-python-headless>=4.6,<6',
        'numba>=0.58,<1',
        'scipy>=1.11,<2',
        'matplotlib>=3.6,<4',
        'mcap>=1.1,<2',
        'rosbags>=0.11,<1',
        'pyyaml>=6,<7',
        'tqdm>=4.62,<5',
    ],
    extras_require={
        # ROS 2 Jazzy itself, for machines without an apt installation of it (x86_64, CPython 3.10 to 3.13).
        'ros': ['ros-jazzy-rclpy[fastrtps]==7.1.6', 'ros-jazzy-common-interfaces==5.3.6'],
        'evaluate': ['evo>=1.28,<2'],
        'test': [
            'catkin_pkg>=1,<2',
            'colcon-ros>=0.5,<1',
            'gtsam>=4.2,<5',
            'hypothesis>=6.80,<7',
            'pytest>=7.4',
            'pytest-timeout>=2.1,<3',
            'pytest-xdist>=3.3,<4',
            'setuptools>=70.1',
        ],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (SHARE, ['package.xml']),
        shared('config'),
        shared('launch'),
        shared('rviz'),
    ],
    entry_points={
        'console_scripts': [
            f'line_slam = {NAME}.cli.main:main',
            f'line_slam_node = {NAME}.nodes.line_slam_node:main',
        ],
    },
    zip_safe=False,
)
