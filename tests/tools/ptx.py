"""PTX of a kernel, as NVRTC writes it, translated to C: executes the compiler's output on the processor, bit by bit.

Covers the instructions of ensemble kernels; others raise ``NotImplementedError``. Registers become variables, local
memory an array, parameters of calls 8 bytes. Calls with structs, which one lane does not take, and the reduction of
large angles abort.
"""

from __future__ import annotations

import re

import pytest

from scvi_codegen.codegen.native import cuda

TYPES = {f"{kind}{bits}": f"uint{bits}_t" for kind in "bu" for bits in (8, 16, 32, 64)}
TYPES |= {f"s{bits}": f"int{bits}_t" for bits in (16, 32, 64)} | {"f64": "double", "pred": "int"}
WIDER = {"u16": "uint32_t", "s16": "int32_t", "u32": "uint64_t", "s32": "int64_t"}
SIGNS = {"add": "+", "sub": "-", "mul": "*", "and": "&", "or": "|", "xor": "^", "shl": "<<", "shr": ">>"}
SIGNS |= {"rem": "%", "div": "/"}
COMPARED = {"eq": "==", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "lo": "<", "ls": "<=", "hi": ">", "hs": ">="}
INVERTED = {"ltu": ">=", "leu": ">", "gtu": "<=", "geu": "<", "neu": "=="}
"""Comparisons that are true for NaN, by their negation."""
SPECIAL = {"%tid.x": "(trajectory % 8)", "%ctaid.x": "(trajectory / 8)", "%ntid.x": "8", "%SP": "SP", "%SPL": "SPL"}
"""Registers of the thread: here every block has eight."""
FUNCTIONS = {"neg": "-{0}", "abs": "fabs({0})", "rcp": "1.0 / {0}", "sqrt": "sqrt({0})", "cvta": "{0}"}
FUNCTIONS |= {"rsqrt": "device_inverse_root({0})", "fma": "fma({0}, {1}, {2})", "min": "({0} < {1} ? {0} : {1})"}
FUNCTIONS |= {
    "max": "({0} > {1} ? {0} : {1})",
    "selp": "({2} ? {0} : {1})",
    "not": "~{0}",
    "copysign": "copysign({1}, {0})",
}

THREAD = "long long trajectory; /* number of the thread */\n"
HEAD = """#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
static inline double of_bits(uint64_t bits) { double x; memcpy(&x, &bits, 8); return x; }
"""
ESTIMATE = """static inline double device_inverse_root(double x)
{
  uint64_t bits;
  memcpy(&bits, &x, 8), bits &= ~0xffffffffULL, memcpy(&x, &bits, 8);
  x = 1.0 / sqrt(x);
  memcpy(&bits, &x, 8), bits &= ~0xffffffffULL, memcpy(&x, &bits, 8);
  return x;
}
"""
"""x^(-1/2) from the high words, as rsqrt.approx.ftz.f64 computes it to 20 bits; a device may round differently."""
LIBRARY = """static uint64_t __internal_accurate_pow(uint64_t x, uint64_t y)
{
  const double z = pow(of_bits(x), of_bits(y));
  uint64_t bits;
  memcpy(&bits, &z, 8);
  return bits;
}
"""
"""Functions of CUDA's library that are calls: those of the processor."""


def ptx_of(text: str, architecture: str) -> str:
    """Return the PTX of a kernel by NVRTC, without fused multiply-add; skip the test if NVRTC is not installed."""
    nvrtc = pytest.importorskip("cuda.bindings.nvrtc")
    options = pytest.importorskip("cuda.core").ProgramOptions(arch=architecture, fma=False, **cuda.OPTIONS)
    words = options.as_bytes("nvrtc")
    _, program = nvrtc.nvrtcCreateProgram(text.encode(), b"kernel", 0, [], [])
    assert not int(nvrtc.nvrtcCompileProgram(program, len(words), words)[0])
    _, size = nvrtc.nvrtcGetPTXSize(program)
    ptx = bytes(size)
    nvrtc.nvrtcGetPTX(program, ptx)
    return ptx.rstrip(b"\0").decode()


def translated(ptx: str) -> str:
    """Return C with a function for each kernel; its thread is the number ``trajectory``."""
    ptx = re.sub(r"//.*", "", ptx)
    parts = [HEAD, THREAD, ESTIMATE, LIBRARY]
    for bits, name, size, values in re.findall(r"\.align \d+ \.b(\d+) (\w+)\[(\d+)\] = \{([^}]*)\}", ptx):
        parts.append(f"static const uint{bits}_t {name}[{size}] __attribute__((aligned(16))) = {{{values}}};")
    own = r"\.func[^{]*?\b__internal_\w+\s*\([^()]*\)\s*\{.*?\n\}"
    aside = r"\.func\s+(?:\([^()]*\)\s*)?(\w+)\s*\([^()]*\.b8[^()]*\)\s*\{.*?\n\}"  # with a struct, of many lanes
    left_out = {match[1] for match in re.finditer(aside, ptx, re.DOTALL)}
    ptx = re.sub(f"{own}|{aside}", "", ptx, flags=re.DOTALL)
    names = "|".join([*left_out, "__internal_trig_reduction_slowpathd"])
    ptx = re.sub(rf"call\.uni\s+(\([^()]*\),\s*)?({names})\s*,[^;]*;", "abort;", ptx)
    functions = re.findall(r"\.func\s+(\(.*?\))?\s*(\w+)\s*\(([^()]*)\)\s*\{(.*?)\n\}", ptx, re.DOTALL)
    heads = [_head(*function[:3]) for function in functions]
    bodies = [_function(head, *function[2:]) for head, function in zip(heads, functions, strict=True)]
    for name, parameters, body in re.findall(r"\.entry (\w+)\((.*?)\)[^{]*\{(.*?)\n\}", ptx, re.DOTALL):
        arguments = ", ".join(f"{TYPES[kind]} {each}" for kind, each in _parameters(parameters))
        bodies.append(_function(f"void {name}({arguments})", parameters, body))
    return "\n".join([*parts, *(f"{head};" for head in heads), *bodies])


def _parameters(text: str) -> list[tuple[str, str]]:
    return re.findall(r"\.param \.(\w+)(?: \.ptr[^,]*?)? (\w+)(?:,|$|\n)", text)


def _head(result: str, name: str, parameters: str) -> str:
    arguments = ", ".join(f"uint64_t {each}" for _, each in _parameters(parameters))
    return f"static {'uint64_t' if result else 'void'} {name}({arguments or 'void'})"


def _function(head: str, parameters: str, body: str) -> str:
    arguments, returns = _parameters(parameters), "func_retval0" in body
    lines = [head, "{", "uint32_t temp = 0; (void)temp;"]
    declared = {*re.findall(r"\.param [^;]*?(\w+)(?:\[\d+\])?;", body), "func_retval0"}
    lines += [f"uint64_t {name} = 0; (void){name};" for name in sorted(declared - {name for _, name in arguments})]
    for depot, size in re.findall(r"\.local \.align \d+ \.b8\s+(\w+)\[(\d+)\]", body):
        lines.append(f"uint8_t {depot}[{size}] __attribute__((aligned(16)));")
    lines.append("uint64_t SP = 0, SPL = 0; (void)SP, (void)SPL;")
    for kind, register, count in re.findall(r"\.reg \.(\w+)\s+%(\w+)<(\d+)>;", body):
        lines.append(f"{TYPES[kind]} {', '.join(f'{register}{k} = 0' for k in range(int(count)))};")
    body = re.sub(r"^\s*(\.(reg|local|pragma|param)[^;]*;|[{}]\s*$)", "", body, flags=re.MULTILINE)
    body = body.replace("ret;", "ret func_retval0;") if returns else body
    for text, end in re.findall(r"([^;:]*(?:::[^;:]*)*)(;|:(?=\s))", body):
        words = " ".join(text.split())
        if end == ":":
            lines.append(f"{words.replace('$', '')}:;")
        elif words:
            lines.append(_statement(words))
    return "\n".join([*lines, "}"])


def _statement(words: str) -> str:
    guard = ""
    if match := re.match(r"@(!?)%(p\d+) (.*)", words):
        guard, words = f"if ({match[1]}{match[2]}) ", match[3]
    operation, _, rest = words.partition(" ")
    name, *kinds = operation.split(".")
    if name == "bra":
        return f"{guard}goto {rest.replace('$', '')};"
    if name == "abort":
        return "abort();"
    if name in ("ret", "exit"):
        return f"{guard}return {rest};"
    if name == "call":
        result, function, values = re.fullmatch(r"(?:\((\w+)\), )?(\w+)(?:, \((.*)\))?", rest).groups()  # type: ignore[union-attr]
        return f"{guard}{f'{result} = ' * bool(result)}{function}({values or ''});"
    return f"{guard}{{ {_assignment(name, kinds, re.split(r', (?![^{]*})', rest))} }}"


def _assignment(name: str, kinds: list[str], arguments: list[str]) -> str:
    kind, last = TYPES.get(kinds[-1], ""), kinds[-1]
    if name in ("ld", "st") and kinds[0] == "param":
        place, number = sorted(arguments, key=lambda each: "[" not in each)
        parameter, _, offset = place.strip("[]").partition("+")
        both = f"*({kind} *)((char *)&{parameter} + {offset or 0})", _value(number)
        return " = ".join(both if name == "st" else both[::-1]) + ";"
    if name in ("ld", "st"):
        numbers, place = arguments if name == "ld" else reversed(arguments)
        base, offset = re.fullmatch(r"\[([%\w$]+)(?:\+?(-?\d+))?\]", place).groups()  # type: ignore[union-attr]
        elements = [_value(each) for each in numbers.strip("{}").split(", ")]
        cells = [f"(({kind} *)((uint64_t){_value(base)} + {offset or 0}))[{k}]" for k in range(len(elements))]
        pairs = zip(elements, cells, strict=True) if name == "ld" else zip(cells, elements, strict=True)
        return " ".join(f"{one} = {other};" for one, other in pairs)
    target, *values = arguments
    half = 32 if last == "b64" else 16
    if name == "mov" and target.startswith("{"):
        low, high = (_value(each) for each in target.strip("{}").split(", "))
        return f"uint{half}_t w[2]; memcpy(w, &{_value(values[0])}, sizeof w); {low} = w[0]; {high} = w[1];"
    if name == "mov" and values[0].startswith("{"):
        low, high = (_value(each) for each in values[0].strip("{}").split(", "))
        return f"uint{half}_t w[2] = {{{low}, {high}}}; memcpy(&{_value(target)}, w, sizeof w);"
    if name == "mov" and last == "b64" and re.match(r"%f?d|0d", values[0]):
        return f"double w = {_value(values[0])}; memcpy(&{_value(target)}, &w, 8);"
    if name == "mov" and last == "b64" and target.startswith(("%fd", "%d")):
        return f"uint64_t w = {_value(values[0])}; memcpy(&{_value(target)}, &w, 8);"
    return f"{_value(target)} = {_expression(name, kinds, [*map(_value, values)])};"


def _expression(name: str, kinds: list[str], x: list[str]) -> str:
    kind, last = TYPES[kinds[-1]], kinds[-1]
    if name == "mov":
        return x[0] if re.match(r"\w+\d|[-\d(]|of_bits|SP", x[0]) else f"(uint64_t){x[0]}"
    if name == "cvt":
        rounding = {"rni": "nearbyint", "rzi": "trunc"}.get(kinds[0], "")
        return f"({TYPES[kinds[-2]]}){rounding}(({kind})({x[0]}))"
    if name == "setp":
        return _comparison(kinds[0], *(each if last == "f64" else f"({kind})({each})" for each in x))
    if last[0] in "su" and (text := _integer(name, kinds, x)):
        return text
    if name in SIGNS:
        return f"({kind})({x[0]}) {SIGNS[name]} ({'uint32_t' if name in ('shl', 'shr') else kind})({x[1]})"
    if name == "not" and last == "pred":
        return f"!{x[0]}"
    if name in FUNCTIONS and (name != "sqrt" or "rn" in kinds):
        return FUNCTIONS[name].format(*x)
    raise NotImplementedError(f"{name}.{'.'.join(kinds)}")


def _integer(name: str, kinds: list[str], x: list[str]) -> str:
    """Return an expression of integers that depends on their type, or nothing."""
    last, each = kinds[-1], [f"({TYPES[kinds[-1]]})({value})" for value in x]
    if "wide" in kinds:
        product = f"({WIDER[last]}){each[0]} * ({WIDER[last]}){each[1]}"
        return product + (f" + {x[2]}" if name == "mad" else "")
    if name == "mad":
        return f"{each[0]} * {each[1]} + {each[2]}"
    if name == "abs":
        return f"({each[0]} < 0 ? -{each[0]} : {each[0]})"
    return FUNCTIONS[name].format(*each) if name in ("min", "max") else ""


def _comparison(how: str, x: str, y: str) -> str:
    if how in INVERTED:
        return f"!({x} {INVERTED[how]} {y})"
    if how in ("nan", "num"):
        return f"{'!' * (how == 'num')}({x} != {x} || {y} != {y})"
    return f"({x} < {y} || {x} > {y})" if how == "ne" else f"{x} {COMPARED[how]} {y}"


def _value(word: str) -> str:
    word = word.strip()
    if word.startswith("0d"):
        return f"of_bits(0x{word[2:]}ULL)"
    return SPECIAL.get(word, word.removeprefix("%")) if word.startswith("%") else word
