"""Minimal importer of FMUs for tests: the library called through ctypes, as specified by FMI 3.0."""

import ctypes
import zipfile
from ctypes import CFUNCTYPE, byref, c_bool, c_char_p, c_double, c_int, c_size_t, c_uint32, c_void_p
from pathlib import Path
from xml.etree import ElementTree

OK, _, DISCARD, ERROR, _ = range(5)
LOG = CFUNCTYPE(None, c_void_p, c_int, c_char_p, c_char_p)


class Fmu:
    """One unpacked; ``variables`` are the attributes of each by name."""

    def __init__(self, path: Path, folder: Path) -> None:
        zipfile.ZipFile(path).extractall(folder)
        self.folder = folder
        self.description = ElementTree.parse(folder / "modelDescription.xml").getroot()
        self.variables = {one.get("name"): one.attrib for one in self.description.find("ModelVariables")}
        [library] = (folder / "binaries").glob("*/*")
        self.library = ctypes.CDLL(str(library))
        self.token = self.description.get("instantiationToken").encode()


class Slave:
    """An instance; calls give their status, ``log`` is what it logged."""

    def __init__(
        self, fmu: Fmu, *, token: bytes | None = None, events: bool = False, early: bool = False, logging: bool = True
    ) -> None:
        self.fmu, self.log = fmu, []
        self._log = LOG(lambda _, status, category, message: self.log.append((status, category, message.decode())))
        instantiate = fmu.library.fmi3InstantiateCoSimulation
        instantiate.restype = c_void_p
        token = fmu.token if token is None else token
        flags = (c_bool(False), c_bool(logging), c_bool(events), c_bool(early))
        self.one = c_void_p(instantiate(b"one", token, None, *flags, None, c_size_t(0), None, self._log, None))

    def call(self, name: str, *arguments: object) -> int:
        return getattr(self.fmu.library, f"fmi3{name}")(self.one, *arguments)

    def start(self, t: float = 0.0, **values: float) -> int:
        """Through the initialization, with values set in it."""
        status = self.call(
            "EnterInitializationMode", c_bool(False), c_double(0), c_double(t), c_bool(False), c_double(0)
        )
        return status or self.set(**values) or self.call("ExitInitializationMode")

    def do_step(self, t: float, size: float) -> tuple[int, bool, bool, bool]:
        """Status; whether an event occurred, whether the simulation ends, and whether the step ended early."""
        flags, last = [c_bool(True) for _ in range(3)], c_double(-1.0)
        status = self.call("DoStep", c_double(t), c_double(size), c_bool(True), *map(byref, flags), byref(last))
        self.last = last.value
        event, terminate, early = (flag.value for flag in flags)
        return status, event, terminate, early

    def step(self, t: float, size: float) -> int:
        status, *flags = self.do_step(t, size)
        assert status != OK or not any(flags)
        return status

    def update_discrete_states(self) -> tuple[bool, bool]:
        """Whether the state changed, and whether the simulation ends."""
        flags, time = [c_bool(True) for _ in range(5)], c_double()
        assert self.call("UpdateDiscreteStates", *map(byref, flags), byref(time)) == OK
        again, terminate, nominals, states, defined = (flag.value for flag in flags)
        assert [again, nominals, defined] == [False, False, False]
        return states, terminate

    def set(self, **values: float) -> int:
        return self._variables("SetFloat64", values, (c_double * len(values))(*values.values()))

    def get(self, *names: str) -> list[float]:
        values = (c_double * len(names))()
        assert self._variables("GetFloat64", names, values) == OK, self.log
        return list(values)

    def _variables(self, call: str, names: object, values: ctypes.Array) -> int:
        references = [int(self.fmu.variables[name]["valueReference"]) for name in names]
        count = c_size_t(len(references))
        return self.call(call, (c_uint32 * len(references))(*references), count, values, count)

    def saved_state(self) -> c_void_p:
        state = c_void_p()
        assert self.call("GetFMUState", byref(state)) == OK
        return state

    def as_bytes(self, state: c_void_p) -> bytes:
        size = c_size_t()
        assert self.call("SerializedFMUStateSize", state, byref(size)) == OK
        buffer = (ctypes.c_uint8 * size.value)()
        assert self.call("SerializeFMUState", state, buffer, size) == OK
        return bytes(buffer)

    def from_bytes(self, data: bytes, state: c_void_p) -> int:
        return self.call("DeserializeFMUState", data, c_size_t(len(data)), byref(state))
