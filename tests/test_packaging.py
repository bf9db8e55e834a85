"""The package as its users get it: a colcon workspace, a wheel, and the metadata of both."""
from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAME = 'line_slam_ros'
SOURCES = ('line_slam_ros', 'msg_adapters', 'launch', 'config', 'rviz', 'resource', 'package.xml', 'setup.py',
           'setup.cfg', 'pyproject.toml', 'README.md', 'LICENSE')
EXECUTABLES = ('line_slam', 'line_slam_node')
# As on Debian and Ubuntu, where OpenCV comes without a distribution of the name that pip knows.
ABSENT = 'a-distribution-that-is-nowhere'


def copy_sources(target: Path) -> Path:
    """The package's files alone, as a checkout has them."""
    target.mkdir(parents=True)
    for name in SOURCES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, target / name, ignore=shutil.ignore_patterns('__pycache__', '*.egg-info'))
        else:
            shutil.copy2(source, target / name)
    return target


def run(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(command, check=False, text=True, capture_output=True, timeout=240, **options)
    assert done.returncode == 0, f'{command} failed:\n{done.stdout}\n{done.stderr}'
    return done


@pytest.fixture(scope='module')
def colcon() -> str:
    program = shutil.which('colcon', path=str(Path(sys.executable).parent))
    if program is None:
        pytest.skip('colcon is not installed: pip install colcon-ros')
    return program


@pytest.fixture(scope='module', params=['--merge-install', '--symlink-install'])
def workspace(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, colcon: str) -> Path:
    """A colcon workspace, built with a requirement that is not there."""
    folder = tmp_path_factory.mktemp('workspace')
    setup_py = copy_sources(folder / 'src' / NAME) / 'setup.py'
    setup_py.write_text(setup_py.read_text().replace('install_requires=[', f'install_requires=[{ABSENT!r}, ', 1))
    assert ABSENT in setup_py.read_text()
    run([colcon, '--log-base', 'log', 'build', request.param, '--event-handlers', 'console_direct+'], cwd=folder)
    return folder


@pytest.fixture(scope='module')
def prefix(workspace: Path) -> Path:
    """Where the package is installed: of its own, or shared with the packages that were built with it."""
    own = workspace / 'install' / NAME
    return own if own.is_dir() else workspace / 'install'


def run_sourced(workspace: Path, command: list[str]) -> str:
    """Output of a command after sourcing the workspace, with the Python of these tests as python3."""
    path = f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}'
    return run(['sh', '-c', '. install/setup.sh && exec "$@"', 'sh', *command], cwd=workspace,
               env=os.environ | {'PATH': path, 'PYTHONPATH': ''}).stdout


@pytest.mark.parametrize('name', EXECUTABLES)
def test_colcon_installs_executables_where_ros2_run_looks(prefix: Path, name: str) -> None:
    executable = prefix / 'lib' / NAME / name
    assert os.access(executable, os.X_OK)
    assert re.match(r'#!.*\bpython', executable.read_text())


def test_colcon_installs_the_share_files(prefix: Path) -> None:
    share = prefix / 'share' / NAME
    assert (prefix / 'share' / 'ament_index' / 'resource_index' / 'packages' / NAME).is_file()
    assert (share / 'package.xml').is_file()
    for folder in ('launch', 'config', 'rviz'):
        sources = {p.name for p in (ROOT / folder).iterdir() if p.is_file()}
        assert sources
        assert {p.name for p in (share / folder).iterdir()} == sources


def test_installed_command_runs_although_a_requirement_has_no_distribution(workspace: Path, prefix: Path) -> None:
    code = f'import importlib.metadata, {NAME}; print({NAME}.__file__, *importlib.metadata.requires({NAME!r}))'
    module, *requirements = run_sourced(workspace, ['python3', '-c', code]).split()
    assert Path(module).is_relative_to(workspace)
    assert ABSENT in requirements
    assert 'replay' in run_sourced(workspace, [str(prefix / 'lib' / NAME / 'line_slam'), '--help'])


def test_wheel_holds_both_packages_and_the_parameter_file(tmp_path: Path) -> None:
    pytest.importorskip('setuptools', minversion='70.1', reason='older ones build wheels with another package')
    source = copy_sources(tmp_path / 'source')
    run([sys.executable, '-m', 'pip', 'wheel', '--no-deps', '--no-build-isolation', '--wheel-dir', str(tmp_path), '.'],
        cwd=source)
    (wheel,) = tmp_path.glob('*.whl')
    names = zipfile.ZipFile(wheel).namelist()
    modules = {str(p.relative_to(ROOT)) for folder in (NAME, 'msg_adapters') for p in (ROOT / folder).rglob('*.py')}
    assert modules <= set(names)
    assert any(name.endswith(f'share/{NAME}/config/line_slam.yaml') for name in names)
    assert {name.split('/')[0] for name in names if '.d' not in name.split('/')[0]} == {NAME, 'msg_adapters'}


def test_package_xml_is_valid_and_agrees_with_setup_py() -> None:
    package_format = pytest.importorskip('catkin_pkg.package')
    warnings: list[str] = []
    package = package_format.parse_package(str(ROOT), warnings=warnings)
    package.validate(warnings=warnings)
    assert not warnings
    assert (package.package_format, package.get_build_type()) == (3, 'ament_python')
    shown = run([sys.executable, 'setup.py', '--quiet', '--name', '--version'], cwd=ROOT).stdout.split()
    assert shown == [package.name, package.version] == [NAME, package.version]
    assert re.search(rf'^## \[{re.escape(package.version)}\]', (ROOT / 'CHANGELOG.md').read_text(), re.MULTILINE)


def test_package_xml_names_every_ros_package_that_the_sources_import() -> None:
    package_format = pytest.importorskip('catkin_pkg.package')
    declared = {dependency.name for dependency in package_format.parse_package(str(ROOT)).exec_depends}
    sources = [p for folder in (NAME, 'msg_adapters', 'launch') for p in (ROOT / folder).rglob('*.py')]
    imported = re.compile(r'^\s*(?:from|import) (rclpy|rcl_interfaces|builtin_interfaces|launch|launch_ros'
                          r'|ament_index_python|\w+_msgs|std_srvs)\b', re.MULTILINE)
    assert {name for path in sources for name in imported.findall(path.read_text())} <= declared
