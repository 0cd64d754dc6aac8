"""Kernels as a WebAssembly module, by LLVM alone: numba's code for this machine, translated for another.

LLVM writes WebAssembly as an object file for a linker. The places that a linker fills already hold their values for the
case that there is nothing to link with. So the object is a module, and lacks only its list of exports. It imports its
memory, mathematical functions, and the few functions of numba's run time that ``page/ball.js`` has.
"""

import re
from collections.abc import Iterator
from typing import Final

import llvmlite.binding as llvm  # type: ignore[import-untyped]

EXPORT: Final = "entry"
TRIPLE: Final = "wasm32-unknown-unknown"
# Pointers of 4 bytes that take up 8, because numba has laid out its structures for a machine of 64 bits
DATA_LAYOUT: Final = "e-m:e-p:32:64-p10:8:8-p20:8:8-i64:64-i128:128-n32:64-S128-ni:1:10:20"
FEATURES: Final = "+bulk-memory,+mutable-globals,+nontrapping-fptoint,+sign-ext"  # in all browsers since 2021
MOST_CONSTANTS: Final = (
    512 * 1024
)  # [bytes] from address 0 on; page/ball.js has the stack after it, up to 1 MiB

# Reference counts are not needed: the memory of a call is given back as a whole
_COUNTS: Final = re.compile(r"^define [^\n]*@(NRT_(?:incref|decref))\(.*?^}\n", re.DOTALL | re.MULTILINE)
_TARGET: Final = re.compile(r'^target (datalayout|triple) = ".*"', re.MULTILINE)
_PROCESSOR: Final = re.compile(r'"target-(?:cpu|features)"="[^"]*"')

# WebAssembly's binary format, and the tool conventions of its object files
_HEADER: Final = b"\0asm\1\0\0\0"
_CUSTOM, _EXPORTS, _DATA = 0, 7, 11  # sections
_SYMBOLS: Final = 8  # subsection of the custom section "linking"
_FUNCTION_SYMBOL, _DATA_SYMBOL, _SECTION_SYMBOL = 0, 1, 3
_UNDEFINED, _EXPLICIT_NAME = 0x10, 0x40  # flags of a symbol


def compiled(text: str) -> bytes:
    """Return the module of LLVM's text of one ``numba.cfunc``, which it exports as ``EXPORT``."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = {"datalayout": DATA_LAYOUT, "triple": TRIPLE}
    text = _COUNTS.sub(r"declare void @\1(ptr)\n", text)
    text = _TARGET.sub(lambda found: f'target {found[1]} = "{target[found[1]]}"', text)
    text = _PROCESSOR.sub("", text)
    text = text.replace(" = common ", " = internal ")  # WebAssembly has no common symbols
    module = llvm.parse_assembly(text)
    for function in module.functions:
        if function.name.startswith("cfunc."):
            function.name = EXPORT
        elif not function.is_declaration:
            function.linkage = "internal"
    module.verify()
    machine = llvm.Target.from_triple(TRIPLE).create_target_machine(opt=2, features=FEATURES)
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return with_export(machine.emit_object(module), EXPORT)


def with_export(built: bytes, function: str) -> bytes:
    """Return an object file as a module that exports a function, without what only a linker reads.

    Raises:
        ValueError: There is no such function, or the constants need the stack's memory.
    """
    sections = list(_sections(built))
    constants = sum(len(content) for kind, content in sections if kind == _DATA)
    if constants > MOST_CONSTANTS:
        raise ValueError(f"{constants} bytes of constants; allowed: {MOST_CONSTANTS}")
    name = function.encode()
    linking = next(
        content for kind, content in sections if kind == _CUSTOM and content[1:].startswith(b"linking")
    )
    numbers = dict(_functions(linking))
    if name not in numbers:
        raise ValueError(f"the object file defines no function {function}")
    export = b"\1" + _leb(len(name)) + name + b"\0" + _leb(numbers[name])
    kept = sorted(
        [*((kind, content) for kind, content in sections if kind != _CUSTOM), (_EXPORTS, export)], key=_order
    )
    return _HEADER + b"".join(bytes([kind]) + _leb(len(content)) + content for kind, content in kept)


class _Reader:
    """Reads the binary format from its start on."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0

    def __bool__(self) -> bool:
        return self._at < len(self._content)

    def number(self) -> int:
        """Return the next unsigned number (LEB128)."""
        value = shift = 0
        while True:
            (byte,) = self.take(1)
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    def take(self, count: int) -> bytes:
        """Return the next bytes."""
        self._at += count
        return self._content[self._at - count : self._at]


def _sections(built: bytes) -> Iterator[tuple[int, bytes]]:
    reader = _Reader(built[len(_HEADER) :])
    while reader:
        kind = reader.number()
        yield kind, reader.take(reader.number())


def _functions(linking: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield names and numbers of the functions that an object file defines."""
    reader = _Reader(linking)
    reader.take(reader.number())  # the section's name
    if (version := reader.number()) != 2:
        raise ValueError(f"object file of version {version}; allowed: 2")
    while reader:
        kind, part = reader.number(), _Reader(reader.take(reader.number()))
        for _ in range(part.number() if kind == _SYMBOLS else 0):
            symbol, flags = part.number(), part.number()
            is_defined = not flags & _UNDEFINED
            if symbol == _DATA_SYMBOL:
                part.take(part.number())
                for _ in range(3 if is_defined else 0):  # segment, offset, size
                    part.number()
                continue
            number = part.number()
            if symbol != _SECTION_SYMBOL and (is_defined or flags & _EXPLICIT_NAME):
                name = part.take(part.number())
                if symbol == _FUNCTION_SYMBOL and is_defined:
                    yield name, number


def _order(section: tuple[int, bytes]) -> float:
    """Return the place of a section: as numbered, but the count of data segments (12) comes before the code (10)."""
    return 9.5 if section[0] == 12 else section[0]


def _leb(value: int) -> bytes:
    found = bytearray()
    while value >= 0x80:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])
