"""What a stranger meets first: a light import, the public names, a wheel that stands alone, extras that are named."""

from __future__ import annotations

import ast
import importlib
import pydoc
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from model_files import room_glb
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from places import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]

CORE = {canonicalize_name(Requirement(line).name) for line in PROJECT["dependencies"]}

# Each of these lives inside one module of ours, which imports it when called.
WRAPPED = ("open3d", "pycolmap", "sionna", "mitsuba")
HEAVY = (
    *WRAPPED,
    "trimesh",
    "torch",
    "drjit",
    "matplotlib",
    "xarray",
    "h5py",
    "scipy",
    "pandas",
    "PIL",
    "skimage",
    "viser",
)

# The public names that notebooks and outside checks rely on, and the members that they use.
PUBLIC = {
    "Camera": ("pinhole", "spherical"),
    "Gaussians": ("save_ply", "load_ply"),
    "Mesh": ("cast", "visible"),
    "RadioField": ("fit", "save", "load", "spectrum", "paths"),
    "Reconstruction": ("from_files", "save", "load", "report"),
    "Scene": ("load",),
    "SpectrumDataset": ("load", "save", "split", "export_exr"),
    "Relevance": ("table", "save", "load", "options"),
    "reconstruct": (),
    "relevance": (),
    "render": (),
    "simulate": (),
    "trace_paths": (),
}

# From a mesh to a field to a spectrum, with what is in the wheel and its core dependencies alone.
TEN_LINES = """
import warprrf as wr
corners = [[x, y, z] for x in (0, 5) for y in (0, 4) for z in (0, 3)]
sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
room = wr.Mesh(corners, [[a, b, c] for p, q, r, s in sides for a, b, c in ((p, q, r), (p, r, s))])
plaster = wr.Material.custom("plaster", relative_permittivity=2.7, conductivity=0.1, scattering=0.4)
scene = wr.Scene(room, [plaster], [0] * len(room.faces))
places = wr.sample_receivers(scene, 16, seed=0)
spectra = wr.simulate(scene, transmitter=(1, 1, 2.5), receivers=places, frequency_hz=300e9, shape=(30, 60))
field = wr.RadioField.fit(room, spectra.split(10)[0])
spectrum = field.spectrum((2.5, 2, 1.5))
"""

IMPORT_NAMES = {
    "sionna": "sionna-rt",
    "skimage": "scikit-image",
    "PIL": "pillow",
    "drjit": "sionna-rt",
    "mitsuba": "sionna-rt",
    "yaml": "pyyaml",
}


def python(
    code: str, interpreter: str = sys.executable, **options: object
) -> subprocess.CompletedProcess[str]:
    """Run ``code``; by another interpreter than this one apart from what the environment adds to its path."""
    isolated = [] if interpreter == sys.executable else ["-I"]
    command = [interpreter, *isolated, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, **options)  # type: ignore[call-overload]


def test_import_loads_no_heavy_package() -> None:
    done = python(f"import sys, warprrf; print([m for m in {HEAVY!r} if m in sys.modules])", cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_public_name_exists_with_its_members(name: str) -> None:
    import warprrf

    value = getattr(warprrf, name)
    assert name in dir(warprrf)
    assert [member for member in PUBLIC[name] if not hasattr(value, member)] == []


LAZY = sorted((ROOT / "warprrf").rglob("__init__.pyi"))


@pytest.mark.parametrize("stub", LAZY, ids=lambda file: file.parent.name)
def test_every_name_of_a_stub_is_what_it_says_and_help_lists_it(stub: Path) -> None:
    """Once all modules are imported too: a module of a package hides what the package's `__getattr__` would find."""
    package = importlib.import_module(".".join(stub.parent.relative_to(ROOT).parts))
    imports = [node for node in ast.parse(stub.read_text()).body if isinstance(node, ast.ImportFrom)]
    homes = {node.names[0].name: importlib.import_module(str(node.module)) for node in imports}
    assert [name for name, home in homes.items() if getattr(package, name) is not getattr(home, name)] == []
    listed = dir(package)
    assert set(listed) <= set(homes)
    text = pydoc.render_doc(package, renderer=pydoc.plaintext)
    assert [name for name in listed if len(re.findall(rf"^ +{name}  +\S", text, re.MULTILINE)) != 1] == []


def test_flat_names_are_few() -> None:
    import warprrf

    assert len(dir(warprrf)) <= 30


def test_unknown_name_is_an_attribute_error() -> None:
    import warprrf

    with pytest.raises(AttributeError, match="no_such_thing"):
        warprrf.no_such_thing  # noqa: B018


def test_version_is_stated_once() -> None:
    import warprrf

    assert warprrf.__version__ == PROJECT["version"]


def _imports(file: Path) -> set[str]:
    """Top-level packages that a file imports anywhere, `require("package", ...)` included."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
        elif (
            isinstance(node, ast.Call)
            and getattr(node.func, "id", getattr(node.func, "attr", "")) == "require"
        ):
            if node.args and isinstance(node.args[0], ast.Constant):
                found.add(str(node.args[0].value).split(".")[0])
    return found


def _sources() -> list[Path]:
    return sorted((ROOT / "warprrf").rglob("*.py"))


@pytest.mark.parametrize("package", WRAPPED)
def test_heavy_package_is_wrapped_by_few_modules(package: str) -> None:
    """One module wraps each; Sionna RT stands on Mitsuba, whose variant its module must choose."""
    users = [f.relative_to(ROOT / "warprrf").as_posix() for f in _sources() if package in _imports(f)]
    assert len(set(users) - ({"rf/sionna_engine.py"} if package == "mitsuba" else set())) <= 1, users


def test_required_extras_exist_and_bring_the_package() -> None:
    """Every `require(package, extra=...)` names an extra that lists the distribution of that package."""
    wrong = []
    for file in _sources():
        for node in ast.walk(ast.parse(file.read_text())):
            if not isinstance(node, ast.Call):
                continue
            if getattr(node.func, "id", getattr(node.func, "attr", "")) != "require" or not node.args:
                continue
            extra = next(
                (k.value for k in node.keywords if k.arg == "extra"),
                node.args[1] if len(node.args) > 1 else None,
            )
            if not isinstance(node.args[0], ast.Constant) or not isinstance(extra, ast.Constant):
                continue
            package = str(node.args[0].value).split(".")[0]
            if canonicalize_name(package) in CORE:
                continue
            listed = {canonicalize_name(Requirement(r).name) for r in EXTRAS.get(str(extra.value), ())}
            if canonicalize_name(IMPORT_NAMES.get(package, package)) not in listed:
                wrong.append(f"{file.name}:{node.lineno}: {package} is not in the extra {extra.value}")
    assert wrong == []


def test_constraints_pin_every_requirement_exactly() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"]
    pinned = {}
    for line in lines:
        requirement = Requirement(line)
        assert re.fullmatch(r"==[\w.+!]+", str(requirement.specifier)), line
        pinned[canonicalize_name(requirement.name)] = str(requirement.specifier)[2:]
    wanted = [Requirement(r) for group in (PROJECT["dependencies"], *EXTRAS.values()) for r in group]
    direct = {canonicalize_name(r.name): r.specifier for r in wanted if r.name != "warprrf"}
    assert sorted(set(direct) - set(pinned)) == []
    assert [name for name, allowed in direct.items() if not allowed.contains(pinned[name])] == []


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "-q",
            "--no-deps",
            "--no-build-isolation",
            "-w",
            str(folder),
            str(ROOT),
        ],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return next(folder.glob("warprrf-*.whl"))


def test_wheel_is_typed_licensed_and_holds_only_the_package(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert "warprrf/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert {name.split("/")[0].split("-")[0] for name in names} == {"warprrf"}
    data = {
        name
        for name in names
        if Path(name).suffix not in (".py", ".pyi", ".typed") and ".dist-info/" not in name
    }
    assert data == {"warprrf/rf/em/p676_oxygen.txt", "warprrf/rf/em/p676_water_vapour.txt"}
    assert wheel.stat().st_size < 670e3  # code alone


def _core_files() -> list[Path]:
    """Top-level files and folders of the core dependencies, theirs included, in this environment."""
    todo, seen = [Requirement(r) for r in PROJECT["dependencies"]], set()
    found: set[Path] = set()
    while todo:
        name = canonicalize_name(todo.pop().name)
        if name in seen:
            continue
        seen.add(name)
        distribution = metadata.distribution(name)
        root = Path(str(distribution.locate_file("")))
        found |= {
            root / f.parts[0] for f in distribution.files or () if f.parts[0] not in ("..", "__pycache__")
        }
        for line in distribution.requires or ():
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                todo.append(requirement)
    return sorted(found)


def test_wheel_works_in_a_fresh_environment_without_extras(wheel: Path, tmp_path: Path) -> None:
    """A new environment gets the wheel and the core dependencies (linked, not downloaded), and no extra."""
    fresh, core = tmp_path / "venv", tmp_path / "core"
    subprocess.run([sys.executable, "-m", "venv", str(fresh)], check=True, timeout=300)
    interpreter = str(fresh / "bin" / "python")
    subprocess.run(
        [interpreter, "-m", "pip", "install", "-q", "--no-deps", "--no-index", str(wheel)],
        check=True,
        timeout=300,
    )
    core.mkdir()
    for source in _core_files():
        (core / source.name).symlink_to(source)
    purelib = python(
        "import sysconfig; print(sysconfig.get_path('purelib'))", interpreter, cwd=tmp_path
    ).stdout.strip()
    (Path(purelib) / "core.pth").write_text(f"{core}\n")

    hidden = python(
        f"import importlib.util as u; print([m for m in {WRAPPED!r} if u.find_spec(m)])",
        interpreter,
        cwd=tmp_path,
    )
    assert hidden.stdout.strip() == "[]", hidden.stderr
    done = python(
        f"import warprrf as wr; [getattr(wr, name) for name in {sorted(PUBLIC)!r}]; print(wr.__file__)",
        interpreter,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert str(fresh) in done.stdout
    assert len(TEN_LINES.strip().splitlines()) == 10
    score = "print(wr.evaluate(spectra.split(10)[1], field.spectrum)['psnr_db'], spectrum.path_gain.sum())"
    done = python(TEN_LINES + score, interpreter, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    psnr_db, path_gain = (float(word) for word in done.stdout.split()[-2:])
    # One room of one material: what is simulated is of the family that is fitted. The line of sight alone, d = 2.06 m,
    # has (c / 4 pi f d)^2 = 1.488e-9.
    assert psnr_db > 45.0
    assert 1.488e-9 < path_gain < 2e-9
    photos = tmp_path / "photos"
    photos.mkdir()
    for index in range(4):
        (photos / f"{index}.jpg").write_bytes(b"")
    done = python(
        f"import warprrf as wr; wr.reconstruct({str(photos)!r}, workspace={str(tmp_path / 'w')!r})",
        interpreter,
        cwd=tmp_path,
    )
    assert done.returncode != 0
    assert 'ImportError: pycolmap is not installed: pip install "warprrf[photos]"' in done.stderr
    room_glb(tmp_path)  # with a texture
    done = python("import warprrf as wr; wr.Mesh.load('room.glb')", interpreter, cwd=tmp_path)
    assert 'ImportError: PIL.Image is not installed: pip install "warprrf[mesh]"' in done.stderr
    done = subprocess.run(
        [str(fresh / "bin" / "warprrf"), "--version"],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=tmp_path,
    )
    assert done.stdout.strip() == f"warprrf {PROJECT['version']}", done.stderr
