"""Count code and files, and what breaks a rule of language: `code_counts.py [FOLDER]`.

Without a folder the whole repository is counted; with one, every place in it that breaks a rule is
listed. `tests/test_language.py` holds the rules.
"""

import argparse
import ast
import functools
import io
import re
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_ARGUMENTS = 6  # positional ones of a function

# Functions of more than six positional arguments, and the reason.
_LOOP = "a compiled loop over columns and its outputs, called once or twice"
_FIT = "public since the first release, in the order of `optimise`"
LONG_SIGNATURES = {
    "_add_prediction": _LOOP, "_interpolate_counts": _LOOP, "_area": _LOOP, "_add_moments": _LOOP,
    "_accumulate_votes": _LOOP, "_warp_and_vote": _LOOP, "_accumulate": _LOOP,
    "make_vector_sums._.function": "numbers and pointers, as LLVM passes them",
    "half_line_residual": "the letters of one equation, public since the first release",
    "confidence_intervals": _FIT, "optimise": _FIT,
    "fit": "public since the first release: all settings of a configuration",
    "_fit_file": "the settings of `fit` for a configuration in a file",
}  # fmt: skip

# An annotation without a shape or a unit, and a text that states a unit.
OPEN_ANNOTATION = r"\b(Any|float|ndarray|NDArray|ArrayLike|Array)\b"
SHAPED_ANNOTATION = r"\b(Float|Int|Bool|Shaped|Num)\["
UNIT_TEXT = r"\b(px|s|us|rad|Hz|m|ln I)\b"

# A docstring that begins so has to be solved before it is read.
STARTS = ("What", "Where", "Whether", "How", "Which", "Of", "Whose", "The same", "As", "By how")

# Adverbs, verbs and participles that have named classes; other participles end in "ed" or "ing".
NOT_NOUNS = {
    *("Told", "Seen", "Given", "Taken", "Asked", "Found", "Passed", "Known", "Held", "Shown"),
    *("Ahead", "Along", "Later", "Again", "Around", "Between", "Beyond"),
    *("Look", "Tell", "Ask", "Own", "Suit", "Choose"),
}
# Nouns that end like participles.
NOUNS = {
    "Recording",
    "Timing",
    "Meaning",
    "Reading",
    "String",
    "Ring",
    "Seed",
    "Speed",
    "Feed",
    "Bed",
    "Setting",
    "Warning",
}

# Words of the left column of the glossary that name nothing any more: in names of classes,
# functions, methods and modules. The right word is beside each.
GLOSSARY = {
    "Slots": "TrackBuffer", "look_ahead": "predict_and_gate", "update_slot": "update_track",
    "begin_slots": "init_tracks", "start_states": "init_states",
    "silence_limits": "coast_limits_us", "stands_still": "is_static", "Verdict": "TrackDecision",
    "judge": "decide_track", "sow": "spawn_seeded_tracks", "count_strays": "accumulate_clutter",
    "end_cycle": "manage_tracks", "Log": "TrackEvents", "Later": "BackwardInfo",
    "look_back": "backward_pass", "nothing_later": "terminal_info",
    "at_end": "propagate_to_chunk_end", "tell_smoothed": "readout_smoothed", "tell": "readout",
    "Mark": "PackingCursor", "Stretch": "Segment", "Following": "NextSegment",
    "Links": "WindowTracker", "Live": "TrackTable", "Seen": "TrackMeasurements",
    "agility": "velocity_noise",
    "Look": "WindowAssociation", "share_out": "assign", "Shares": "Assignments",
    "Ground": "ClutterModel", "Told": "a noun", "Choice": "ScaleSelection, ModelSelection",
    "unite": "merge_paths", "advance": "predict", "jump": "event_update", "observe": "frame_model",
    "Observer": "FrameModel", "outset": "initial_level", "Place": "LaneBlock",
    "Held": "ZeroOrderHold", "Blended": "LinearBlend", "BetweenFrames": "FrameInterpolation",
    "Nothing": "NoFrames", "belief": "effective_certainty", "believed_rate": "frame_information",
    "Growth": "DeadTimeDerivative", "Passage": "SmoothedWindow", "Link": "MessageMap",
    "Measured": "FrameMeasurements", "Sided": "CensoredPixels", "held_by_pixel": "pixel_state_spec",
    "through": "apply_link", "of_pixel": "pixel_functions", "shared": "redistribute_pixel_count",
    "Follower": "TrajectoryEstimator", "Followed": "TrajectoryEstimate",
    "Shutter": "FrameExposures", "Taken": "AdjacentExposures", "Shots": "AdjacentFrames",
    "Along": "WarpedImages", "spread_purely": "interpolate_paths_jax",
    "warp_purely": "warp_images_jax",
    "agree": "robust_mean", "agree_purely": "robust_mean_jax", "Agreement": "RobustMean",
    "shown": "visibility", "compare": "fusion_features", "Comparison": "FusionFeatures",
    "decide": "fuse_candidates", "whose": "path_index", "Course": "MotionClock",
    "stand_out": "subtract_local_mean",
    "Divided": "PartitionedRecording", "ImageRoom": "BufferPool", "room": "scratch",
    "Motion": "MotionEstimate", "decided": "is_observable", "Layers": "FlowConsistency",
    "layers": "flow_consistency", "Gatherer": "PairSampler", "Passed": "BatchTiming",
    "Weighed": "ReweightResult", "around": "init_near", "anywhere": "init_uniform",
    "ask": "init_votes", "add_votes": "accumulate_votes", "look": "evaluate",
    "Acceptance": "StepControl", "ahead": "extrapolation", "goes_on": "should_continue",
    "weigh": "reweight, robust_weights", "misfit": "residual", "misfits": "residuals",
    "before_a_plane": "planar_solutions", "Trial": "HeldOutTest", "ended": "refine_final",
    "followed": "refine_from", "rounds": "refine_coarse_to_fine", "tilt": "update_plane_normal",
    "Suited": "AdaptedParams", "suit": "adapt_params", "Given": "HostInputs",
    "Stacked": "StackedRuns", "Described": "ShortRepr", "Shown": "HtmlRepr",
    "Share": "UnitInterval", "Believed": "LossWithPrior", "slopes": "loss_and_grad",
    "examine": "confidence_intervals", "Finding": "ParameterInterval", "gathered": "allgather",
    "packed": "serialise", "by_first": "on_process_zero", "in_step": "on_all_processes",
    "run_in_turn": "use_synchronous_dispatch", "lean": "njit_noalloc", "fast": "njit_fastmath",
    "part": "njit_inlined", "lean_part": "njit_noalloc_inlined", "Blank": "ZeroedScratch",
    "again": "evaluate", "Known": "Constant", "OfParameters": "ParameterValue", "kept": "cache",
    "Opened": "RecordingCache", "Contents": "FileHashes",
}  # fmt: skip

# Names in capitals, in text, of other programs and of file formats.
FOREIGN_NAMES = {"XLA_FLAGS", "TIME_HIGH", "CD_ON", "CD_OFF"}

# Words of that column that stay, and why.
KEPT_WORDS: dict[str, str] = {
    "Choice": "a parameter that is one of a few values; no other class has the name",
}


@dataclass(frozen=True)
class Definition:
    """A class, function or method of a file, with the names of what it stands in."""

    path: Path
    name: str
    node: ast.ClassDef | ast.FunctionDef
    inside: tuple[str, ...]
    in_class: bool

    @property
    def is_public(self) -> bool:
        return not any(name.startswith("_") for name in (*self.inside, self.name))

    @property
    def place(self) -> str:
        name = ".".join((*self.inside, self.name))
        return f"{self.path.relative_to(ROOT)}:{self.node.lineno} {name}"

    @property
    def arguments(self) -> list[str]:
        """Names of the positional arguments of a function, without `self` and `cls`."""
        if isinstance(self.node, ast.ClassDef):
            return []
        names = [a.arg for a in (*self.node.args.posonlyargs, *self.node.args.args)]
        return [name for name in names if name not in ("self", "cls")]

    @property
    def keywords(self) -> list[str]:
        """Names of the arguments of a function that are taken by keyword alone."""
        return (
            []
            if isinstance(self.node, ast.ClassDef)
            else [a.arg for a in self.node.args.kwonlyargs]
        )

    @property
    def open_arguments(self) -> list[str]:
        """Names of the arguments of a function whose annotation leaves shape or unit open."""
        if isinstance(self.node, ast.ClassDef):
            return []
        signature = self.node.args
        arguments = [*signature.posonlyargs, *signature.args, *signature.kwonlyargs]
        return [a.arg for a in arguments if a.arg not in ("self", "cls") and is_open(a.annotation)]

    @property
    def docstring(self) -> str:
        return ast.get_docstring(self.node) or ""

    @property
    def is_overload(self) -> bool:
        """True for a variant or a setter of a function that is documented elsewhere."""
        marks = {ast.unparse(one).split(".")[-1] for one in self.node.decorator_list}
        return bool(marks & {"overload", "setter"})


def is_open(annotation: ast.expr | None) -> bool:
    """Return true if an annotation leaves a shape or a unit open."""
    text = "Any" if annotation is None else ast.unparse(annotation)
    return bool(re.search(OPEN_ANNOTATION, text)) and not re.search(SHAPED_ANNOTATION, text)


def unexplained_fields(one: Definition) -> list[str]:
    """Names of the open fields of a class that neither a comment nor the docstring explains."""
    lines = one.path.read_text().splitlines()
    found = []
    for node in one.node.body:
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
            continue
        near = [lines[node.lineno - 2].strip(), *lines[node.lineno - 1 : node.end_lineno]]
        has_comment = near[0].startswith("#") or any("#" in line for line in near[1:])
        if is_open(node.annotation) and not has_comment:
            if not re.search(rf"\b{node.target.id}\b", one.docstring):
                found.append(node.target.id)
    return found


def needs_arguments(one: Definition) -> bool:
    """Return true if a documented function leaves shapes or units of its arguments open."""
    if not one.docstring or "Args:" in one.docstring or not one.open_arguments:
        return False
    several = len(one.arguments) + len(one.keywords) >= 2
    return several and not re.search(UNIT_TEXT, one.docstring)


def files_of(*folders: str) -> list[Path]:
    """Python files of some folders of the repository, sorted."""
    return sorted(
        p for f in folders for p in (ROOT / f).rglob("*.py") if "__pycache__" not in p.parts
    )


def count_code_lines(text: str) -> int:
    """Count the lines of a Python text that hold code: no blanks, comments or docstrings."""
    skipped: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                if isinstance(first.value.value, str) and first.end_lineno:
                    skipped.update(range(first.lineno, first.end_lineno + 1))
    blank = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in blank and token.type != tokenize.ENDMARKER:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - skipped)


def definitions_of(path: Path) -> Iterator[Definition]:
    """Yield every class, function and method of a file, nested ones too."""

    def walk(
        nodes: list[ast.stmt], inside: tuple[str, ...], in_class: bool
    ) -> Iterator[Definition]:
        for node in nodes:
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                yield Definition(path, node.name, node, inside, in_class)
                # What a function defines is private to it.
                mark = () if isinstance(node, ast.ClassDef) else ("_",)
                yield from walk(
                    node.body, (*inside, node.name, *mark), isinstance(node, ast.ClassDef)
                )
            elif isinstance(node, ast.If | ast.With | ast.Try):
                yield from walk(node.body, inside, in_class)

    yield from walk(parse(path).body, (), False)


@functools.cache
def parse(path: Path) -> ast.Module:
    """Parse a file, once."""
    return ast.parse(path.read_text())


def public_files() -> dict[Path, set[str] | None]:
    """Return the files that a page of the reference shows, with the names shown; None: all."""
    pages = "\n".join(page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    files: dict[Path, set[str] | None] = {}
    pattern = r"^::: ([\w.]+)(?:\n    options: \{.*?members: (\[.*?\]|false))?"
    for module, members in re.findall(pattern, pages, re.M):
        base = ROOT.joinpath(*module.split("."))
        file = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
        known = files.get(file, set())
        names = set(re.findall(r"\w+", members)) - {"false"} if members else None
        files[file] = None if names is None or known is None else known | names
    return {file: names for file, names in files.items() if file.exists()}


def exported_names() -> dict[Path, set[str]]:
    """Names that `__init__` files import for users, by the file that defines them."""
    found: dict[Path, set[str]] = {}
    for path in (ROOT / "jaxevent").rglob("__init__.py"):
        tree = ast.parse(path.read_text())
        lists = [
            n
            for n in tree.body
            if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "__all__"
        ]
        if not lists:
            continue
        names = set(ast.literal_eval(lists[0].value))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                home = ROOT.joinpath(*node.module.split(".")).with_suffix(".py")
                if home.exists():
                    found.setdefault(home, set()).update(
                        a.name for a in node.names if a.name in names
                    )
    return found


def documented_methods(paths: list[Path]) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Return the bases and the documented methods of every class, by its name."""
    bases: dict[str, set[str]] = {}
    methods: dict[str, set[str]] = {}
    for path in paths:
        for one in definitions_of(path):
            if isinstance(one.node, ast.ClassDef):
                names = {re.sub(r"\[.*", "", ast.unparse(base)) for base in one.node.bases}
                bases.setdefault(one.name, set()).update(name.split(".")[-1] for name in names)
            elif one.in_class and one.docstring:
                methods.setdefault(one.inside[-1], set()).add(one.name)
    return bases, methods


def is_documented_by_base(
    one: Definition, bases: dict[str, set[str]], methods: dict[str, set[str]]
) -> bool:
    """Return true for a method that overrides a documented one of a base class."""
    pending, seen = list(bases.get(one.inside[-1], ())) if one.in_class else [], set()
    while pending:
        name = pending.pop()
        if one.name in methods.get(name, ()):
            return True
        if name not in seen:
            seen.add(name)
            pending += bases.get(name, ())
    return False


def is_public_surface(
    one: Definition, pages: dict[Path, set[str] | None], exported: dict[Path, set[str]]
) -> bool:
    """Return true if users see a definition: in the reference, or exported by a package."""
    if not one.is_public:
        return False
    top = (*one.inside, one.name)[0]
    shown = pages.get(one.path, set())
    return shown is None or top in shown or top in exported.get(one.path, set())


def begins_badly(docstring: str) -> bool:
    """Return true if a docstring begins with a word that leaves its sentence open."""
    return any(re.match(rf"{start}\b", docstring) for start in STARTS)


def is_no_noun(name: str) -> bool:
    """Return true if a class is named by a participle, an adverb or a verb."""
    words = re.findall(r"[A-Z][a-z0-9]*", name)
    if not words or words[-1] in NOUNS:
        return False
    return words[-1] in NOT_NOUNS or words[-1].endswith("ed") or (words[-1].endswith("ing"))


@functools.cache
def split_text(path: Path) -> tuple[set[str], list[tuple[int, str]]]:
    """Return the words of a file's code, and its comments and docstrings with their lines."""
    words, texts, begins = set[str](), list[tuple[int, str]](), True
    for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
        if token.type == tokenize.COMMENT or (begins and token.type == tokenize.STRING):
            texts.append((token.start[0], token.string))
        elif token.type != tokenize.OP:
            words.update(re.findall(r"\w+", token.string))
        if token.type not in (tokenize.COMMENT, tokenize.NL):
            begins = token.type in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
    return words, texts


def unknown_constants(paths: list[Path]) -> list[str]:
    """List the constants that comments and docstrings of some files name, and no file defines."""
    known = FOREIGN_NAMES.union(*(split_text(path)[0] for path in files_of("jaxevent")))
    return [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for path in paths
        for line, text in split_text(path)[1]
        for name in re.findall(r"\b[A-Z][A-Z0-9]*_[A-Z0-9_]+\b", text)
        if name not in known
    ]


def broken_rules(paths: list[Path]) -> dict[str, list[str]]:
    """List the places in some files of the package that break a rule of its language.

    Args:
        paths: Files of the package.

    Returns:
        Places by rule, each as "path:line name".
    """
    pages, exported = public_files(), exported_names()
    bases, methods = documented_methods(files_of("jaxevent"))
    found: dict[str, list[str]] = {
        "docstring begins badly": [], "public surface without docstring": [],
        "public surface without Args or Returns": [], "more than six positional arguments": [],
        "class is no noun": [], "word of the old glossary": [],
        "shape or unit open without Args": [], "field without unit": [],
        "text names an unknown constant": unknown_constants(paths),
    }  # fmt: skip
    for path in paths:
        if begins_badly(ast.get_docstring(parse(path)) or ""):
            found["docstring begins badly"].append(f"{path.relative_to(ROOT)}:1")
        for one in definitions_of(path):
            if begins_badly(one.docstring):
                found["docstring begins badly"].append(one.place)
            if len(one.arguments) > MOST_ARGUMENTS:
                reason = LONG_SIGNATURES.get(one.place.split()[-1], "no reason is known")
                found["more than six positional arguments"].append(
                    f"{one.place} {len(one.arguments)}: {reason}"
                )
            if isinstance(one.node, ast.ClassDef):
                found["field without unit"] += [
                    f"{one.place}.{field}" for field in unexplained_fields(one)
                ]
            elif needs_arguments(one) and not is_documented_by_base(one, bases, methods):
                found["shape or unit open without Args"].append(one.place)
            if isinstance(one.node, ast.ClassDef) and is_no_noun(one.name):
                found["class is no noun"].append(one.place)
            if one.name in GLOSSARY and one.name not in KEPT_WORDS:
                found["word of the old glossary"].append(f"{one.place} -> {GLOSSARY[one.name]}")
            if not is_public_surface(one, pages, exported):
                continue
            if not (one.docstring or one.is_overload or one.name == "__init__"):
                if not is_documented_by_base(one, bases, methods):
                    found["public surface without docstring"].append(one.place)
            several = len(one.arguments) + len(one.keywords) >= 2
            if several and one.docstring and isinstance(one.node, ast.FunctionDef):
                gives = one.node.returns is not None and ast.unparse(one.node.returns) not in (
                    "None",
                    "NoReturn",
                )
                parts = ["Args:"] + (["Returns:"] if gives else [])
                if not all(
                    p in one.docstring or (p == "Returns:" and "Yields:" in one.docstring)
                    for p in parts
                ):
                    found["public surface without Args or Returns"].append(one.place)
    return found


def main() -> None:
    """Print sizes, and the places that break a rule."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", help="list the places of this folder of the package")
    folder = parser.parse_args().folder
    for name in [folder] if folder else ["jaxevent", "tests", "experiments"]:
        paths = files_of(name)
        lines = sum(count_code_lines(p.read_text()) for p in paths)
        print(f"{name}: {lines} lines of code in {len(paths)} files")
    for rule, places in broken_rules(files_of(folder or "jaxevent")).items():
        print(f"{rule}: {len(places)}")
        if folder:
            print("".join(f"    {place}\n" for place in places), end="")


if __name__ == "__main__":
    main()
