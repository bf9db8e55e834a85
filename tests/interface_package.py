"""Builds a ROS message package from .msg texts with gcc alone, for packages that the wheels do not have (tf2_msgs).

What rosidl's CMake macros do for a real package: .msg -> .idl -> type hashes -> C code and its type supports -> Python
extension. The result is a directory to put on sys.path.
"""
from __future__ import annotations

import json
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

PREFIX = Path(sys.prefix)
SHARE = PREFIX / 'share'
TYPE_SUPPORTS = ('rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_introspection_c', 'rosidl_typesupport_c')
GENERATORS = ('rosidl_generator_c', *TYPE_SUPPORTS, 'rosidl_generator_py')
INIT = '''"""Loads the libraries that the extension modules need."""
import ctypes
import pathlib

for name in {names}:
    ctypes.CDLL(str(pathlib.Path(__file__).parent / f'lib{package}__{{name}}.so'), mode=ctypes.RTLD_GLOBAL)
'''


def missing_tools() -> list[str]:
    """What has to be installed first; empty if everything is there."""
    modules = ('rosidl_adapter', 'catkin_pkg', *GENERATORS)
    return ([tool for tool in ('gcc', 'g++') if shutil.which(tool) is None]
            + [module for module in modules if not is_importable(module)])


def is_importable(module: str) -> bool:
    """Whether it is installed and whole."""
    try:
        __import__(module)
    except ImportError:
        return False
    return True


class InterfacePackage:
    """One package in the making."""

    def __init__(self, name: str, messages: Mapping[str, str], dependencies: Sequence[str], directory: Path) -> None:
        """messages maps a name to its .msg text; dependencies are installed packages whose types it uses."""
        self.name, self.dependencies = name, dependencies
        self.source, self.generated, self.site = (directory / part for part in ('source', 'generated', 'site'))
        self.package = self.site / name
        self.package.mkdir(parents=True)
        (self.source / 'msg').mkdir(parents=True)
        for message, text in messages.items():
            (self.source / 'msg' / f'{message}.msg').write_text(text)
        self.messages = tuple(messages)

    def build(self) -> Path:
        """The directory to put on sys.path."""
        self._generate()
        self._visibility_headers()
        self._compile()
        python = self.generated / 'rosidl_generator_py' / self.name
        shutil.copytree(python, self.package, dirs_exist_ok=True, ignore=shutil.ignore_patterns('*.c'))
        (self.package / '__init__.py').write_text(INIT.format(names=GENERATORS, package=self.name))
        return self.site

    def _generate(self) -> None:
        from rosidl_adapter.msg import convert_msg_to_idl
        from rosidl_generator_c import generate_c
        from rosidl_generator_py import generate_py
        from rosidl_generator_type_description import generate_type_hash
        from rosidl_typesupport_c import generate_c as generate_typesupport
        from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
        from rosidl_typesupport_introspection_c import generate_c as generate_introspection

        for message in self.messages:
            convert_msg_to_idl(self.source, self.name, Path('msg') / f'{message}.msg', self.generated / 'idl' / 'msg')
        hashes = 'rosidl_generator_type_description'
        generate_type_hash(self._arguments(hashes))
        described = [f'msg/{m}.idl:{self.generated}/{hashes}/{self.name}/msg/{m}.json' for m in self.messages]
        generate_c(self._arguments('rosidl_generator_c', type_description_tuples=described))
        generate_typesupport_fastrtps_c(self._arguments('rosidl_typesupport_fastrtps_c'))
        generate_introspection(self._arguments('rosidl_typesupport_introspection_c'))
        generate_typesupport(self._arguments('rosidl_typesupport_c'), list(TYPE_SUPPORTS[:2]))
        (self.generated / 'rosidl_generator_py' / self.name / 'msg').mkdir(parents=True)
        generate_py(self._arguments('rosidl_generator_py'), list(TYPE_SUPPORTS))

    def _arguments(self, generator: str, **more: object) -> str:
        """Path of the JSON file that every rosidl generator reads its arguments from."""
        interfaces = [f'{package}:{idl}' for package in self.dependencies
                      for idl in sorted((SHARE / package / 'msg').glob('*.idl'))]
        described = [path.name for path in SHARE.iterdir() if (path / 'msg').is_dir()]
        arguments = {
            'package_name': self.name, 'output_dir': str(self.generated / generator / self.name),
            'template_dir': str(SHARE / generator / 'resource'), 'target_dependencies': [],
            'idl_tuples': [f'{self.generated}/idl:msg/{message}.idl' for message in self.messages],
            'ros_interface_files': [str(self.source / 'msg' / f'{message}.msg') for message in self.messages],
            'ros_interface_dependencies': interfaces,
            'include_paths': [f'{package}:{SHARE / package}' for package in described], **more}
        path = self.generated / f'{generator}.json'
        path.write_text(json.dumps(arguments))
        return str(path)

    def _visibility_headers(self) -> None:
        for generator in ('rosidl_generator_c', 'rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_introspection_c'):
            name = f'{generator}__visibility_control.h'
            text = (SHARE / generator / 'resource' / f'{name}.in').read_text()
            text = text.replace('@PROJECT_NAME@', self.name).replace('@PROJECT_NAME_UPPER@', self.name.upper())
            (self.generated / generator / self.name / 'msg' / name).write_text(text)

    def _compile(self) -> None:
        c_library = f'{self.name}__rosidl_generator_c'
        self._library('rosidl_generator_c', [
            'rosidl_runtime_c', 'rcutils', *self._of_dependencies('rosidl_generator_c')])
        self._library('rosidl_typesupport_fastrtps_c', [
            c_library, 'fastcdr', 'rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_fastrtps_cpp',
            *self._of_dependencies('rosidl_typesupport_fastrtps_c')])
        self._library('rosidl_typesupport_introspection_c', [
            c_library, 'rosidl_typesupport_introspection_c',
            *self._of_dependencies('rosidl_typesupport_introspection_c')])
        self._library('rosidl_typesupport_c', [c_library, 'rosidl_typesupport_c'])
        python = self.generated / 'rosidl_generator_py' / self.name
        self._link(f'lib{self.name}__rosidl_generator_py.so', sorted((python / 'msg').glob('*_s.c')),
                   [c_library, *self._of_dependencies('rosidl_generator_py')])
        for support in TYPE_SUPPORTS:
            self._link(f'{self.name}_s__{support}.so', [python / f'_{self.name}_s.ep.{support}.c'],
                       [f'{self.name}__rosidl_generator_py', f'{self.name}__{support}', c_library,
                        'rosidl_typesupport_c'])

    def _of_dependencies(self, kind: str) -> list[str]:
        return [f'{dependency}__{kind}' for dependency in self.dependencies]

    def _library(self, generator: str, libraries: Sequence[str]) -> None:
        folder = self.generated / generator
        sources = sorted([*folder.rglob('*.c'), *folder.rglob('*.cpp')])
        self._link(f'lib{self.name}__{generator}.so', sources, libraries)

    def _link(self, output: str, sources: Sequence[Path], libraries: Sequence[str]) -> None:
        compiler = ['g++', '-std=c++17'] if any(s.suffix == '.cpp' for s in sources) else ['gcc', '-std=gnu11']
        headers = [PREFIX / 'include', *(path for path in (PREFIX / 'include').iterdir() if path.is_dir()),
                   *(self.generated / name for name in GENERATORS), sysconfig.get_path('include'), np.get_include()]
        subprocess.run([
            *compiler, '-O1', '-DNDEBUG', '-fPIC', '-shared', '-w', f'-Wl,-soname,{output}',
            '-o', str(self.package / output), *map(str, sources), *(f'-I{path}' for path in headers),
            f'-L{PREFIX / "lib"}', f'-L{self.package}', '-Wl,--allow-shlib-undefined',
            f'-Wl,-rpath-link,{PREFIX / "lib"}', '-Wl,-rpath,$ORIGIN', *(f'-l{name}' for name in libraries)],
            check=True)
