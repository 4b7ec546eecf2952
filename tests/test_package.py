"""What a stranger meets first: a light import, the public names, a wheel that stands alone, extras that are named."""

import ast
import importlib
import inspect
import operator
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

import warprrf

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]

CORE = {canonicalize_name(Requirement(line).name) for line in PROJECT["dependencies"]}

# Each of these lives inside one module of ours, which imports it when called.
WRAPPED = ("open3d", "pycolmap", "sionna", "mitsuba")
HEAVY = (
    *WRAPPED, "trimesh", "torch", "drjit", "matplotlib", "xarray", "h5py", "scipy", "pandas", "PIL", "skimage", "viser",
)  # fmt: skip

# What notebooks and outside checks rely on.
PUBLIC = """
Camera.pinhole Camera.spherical Gaussians.save_ply Gaussians.load_ply Mesh.cast Mesh.visible RadioField.fit RadioField.save
RadioField.load RadioField.spectrum RadioField.paths Reconstruction.from_files Reconstruction.save Reconstruction.load
Reconstruction.report Scene.load SpectrumDataset.load SpectrumDataset.save SpectrumDataset.split SpectrumDataset.export_exr
Relevance.table Relevance.save Relevance.load Relevance.needs reconstruct relevance render simulate trace_paths
""".split()

# From a mesh to a field to a spectrum, with what is in the wheel and its core dependencies alone.
TEN_LINES = """
import warprrf as wr
corners = [[x, y, z] for x in (0, 5) for y in (0, 4) for z in (0, 3)]
sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
room = wr.Mesh(corners, [[a, b, c] for p, q, r, s in sides for a, b, c in ((p, q, r), (p, r, s))])
plaster = wr.Material.custom("plaster", relative_permittivity=2.7, conductivity=0.1, scattering=0.4)
scene = wr.Scene(room, [plaster], [0] * len(room.faces))
places = wr.sample_receivers(scene, 12, seed=0)
spectra = wr.simulate(scene, transmitter=(1, 1, 2.5), receivers=places, frequency_hz=300e9, shape=(20, 40))
field = wr.RadioField.fit(room, spectra.split(8)[0])
spectrum = field.spectrum((2.5, 2, 1.5))
"""

IMPORT_NAMES = {
    "sionna": "sionna-rt", "skimage": "scikit-image", "PIL": "pillow", "drjit": "sionna-rt", "mitsuba": "sionna-rt",
    "yaml": "pyyaml",
}  # fmt: skip


def run(*words, cwd=None, fails=False):
    """What a program writes to standard output; to standard error where it is to fail."""
    command = list(map(str, words))
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=cwd, check=False)
    assert (done.returncode != 0) is fails, done.stderr
    return (done.stderr if fails else done.stdout).strip()


def test_import_loads_no_heavy_package():
    code = f"import sys, warprrf; print([m for m in {HEAVY!r} if m in sys.modules])"
    assert run(sys.executable, "-c", code, cwd=ROOT) == "[]"


def test_public_names_are_there_and_flat_ones_few():
    assert [name for name in PUBLIC if not operator.attrgetter(name)(warprrf)] == []
    assert {name.split(".")[0] for name in PUBLIC} <= set(dir(warprrf))
    assert sum(not inspect.ismodule(getattr(warprrf, name)) for name in dir(warprrf)) <= 30
    with pytest.raises(AttributeError, match="no_such_thing"):
        warprrf.no_such_thing  # noqa: B018
    assert warprrf.__version__ == PROJECT["version"]


LAZY = sorted((ROOT / "warprrf").rglob("__init__.pyi"))


@pytest.mark.parametrize("stub", LAZY, ids=lambda file: file.parent.name)
def test_every_name_of_a_stub_is_what_it_says_and_help_lists_it(stub):
    """Once all modules are imported too: a module of a package hides what the package's `__getattr__` would find."""
    package = importlib.import_module(".".join(stub.parent.relative_to(ROOT).parts))
    imports = [node for node in ast.parse(stub.read_text()).body if isinstance(node, ast.ImportFrom)]
    homes = {node.names[0].name: importlib.import_module(str(node.module)) for node in imports}
    assert [name for name, home in homes.items() if getattr(package, name) is not getattr(home, name)] == []
    listed = dir(package)
    assert set(listed) == set(homes)
    text = pydoc.render_doc(package, renderer=pydoc.plaintext)
    assert [name for name in listed if len(re.findall(rf"^ +{name}  +\S", text, re.MULTILINE)) != 1] == []


REQUIRED = re.compile(r'require\("([\w.]+)", extra="(\w+)"\)')


@pytest.fixture(scope="module")
def imports():
    """Import statements of every module of ours, and its text."""
    texts = {file.name: file.read_text() for file in (ROOT / "warprrf").rglob("*.py")}
    kinds = (ast.Import, ast.ImportFrom)
    return [
        (name, [ast.unparse(n) for n in ast.walk(ast.parse(text)) if isinstance(n, kinds)], text)
        for name, text in texts.items()
    ]


@pytest.mark.parametrize("package", WRAPPED)
def test_heavy_package_is_wrapped_by_one_module(package, imports):
    def used(statements, text):
        named = [re.match(rf"(import|from) {package}\b", statement) for statement in statements]
        return any(named) or f'require("{package}' in text

    users = [name for name, statements, text in imports if used(statements, text)]
    assert len(users) <= 1, users


def test_required_extras_exist_and_bring_the_package():
    wrong, found = [], 0
    for file in sorted((ROOT / "warprrf").rglob("*.py")):
        for module, extra in REQUIRED.findall(file.read_text()):
            package, found = module.split(".")[0], found + 1
            listed = CORE | {canonicalize_name(Requirement(r).name) for r in EXTRAS.get(extra, ())}
            if canonicalize_name(IMPORT_NAMES.get(package, package)) not in listed:
                wrong.append(f"{file.name}: {package} is not in the extra {extra}")
    assert wrong == [] and found > 20


def test_constraints_pin_every_requirement_exactly():
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
def wheel(tmp_path_factory):
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    build = "-m pip wheel -q --no-deps --no-build-isolation -w".split()
    run(sys.executable, *build, folder, ROOT)
    return next(folder.glob("warprrf-*.whl"))


def test_wheel_is_typed_licensed_and_holds_only_the_package(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert "warprrf/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert {name.split("/")[0].split("-")[0] for name in names} == {"warprrf"}
    code = (".py", ".pyi", ".typed")
    data = {name for name in names if Path(name).suffix not in code and ".dist-info/" not in name}
    assert data == {"warprrf/rf/em/p676_oxygen.txt", "warprrf/rf/em/p676_water_vapour.txt"}
    assert wheel.stat().st_size < 800e3  # code alone


def _core_files():
    """Top-level files and folders of the core dependencies, theirs included, in this environment."""
    todo, seen = [Requirement(r) for r in PROJECT["dependencies"]], set()
    found = set()
    while todo:
        name = canonicalize_name(todo.pop().name)
        if name in seen:
            continue
        seen.add(name)
        distribution = metadata.distribution(name)
        root = Path(str(distribution.locate_file("")))
        first = {f.parts[0] for f in distribution.files or ()} - {"..", "__pycache__"}
        found |= {root / name for name in first}
        for line in distribution.requires or ():
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                todo.append(requirement)
    return sorted(found)


def test_wheel_works_in_a_fresh_environment_without_extras(wheel, tmp_path):
    """A new environment gets the wheel and the core dependencies (linked, not downloaded), and no extra."""
    fresh, core = tmp_path / "venv", tmp_path / "core"
    run(sys.executable, "-m", "venv", "--without-pip", fresh)
    alone = (fresh / "bin" / "python", "-I")  # apart from what the environment adds to the path
    pip = (sys.executable, "-m", "pip", "--python", alone[0])
    run(*pip, "install", "-q", "--no-deps", "--no-index", wheel)
    core.mkdir()
    for source in _core_files():
        (core / source.name).symlink_to(source)
    purelib = run(*alone, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))")
    (Path(purelib) / "core.pth").write_text(f"{core}\n")

    def python(code, **how):
        return run(*alone, "-c", code, cwd=tmp_path, **how)

    assert python(f"import importlib.util as u; print([m for m in {WRAPPED!r} if u.find_spec(m)])") == "[]"
    names = sorted({name.split(".")[0] for name in PUBLIC})
    every = f"import warprrf as wr; [getattr(wr, n) for n in {names!r}]; print(wr.__file__)"
    assert str(fresh) in python(every)
    assert len(TEN_LINES.strip().splitlines()) == 10
    score = "print(wr.evaluate(spectra.split(8)[1], field.spectrum)['psnr_db'], spectrum.path_gain.sum())"
    psnr_db, path_gain = (float(word) for word in python(TEN_LINES + score).split()[-2:])
    # One room of one material: what is simulated is of the family that is fitted. The line of sight alone, d = 2.06 m,
    # has (c / 4 pi f d)^2 = 1.488e-9.
    assert psnr_db > 45.0
    assert 1.488e-9 < path_gain < 2e-9
    room_glb(tmp_path)  # with a texture
    told = 'ImportError: PIL.Image is not installed: pip install "warprrf[mesh]"'
    assert told in python("import warprrf as wr; wr.Mesh.load('room.glb')", fails=True)
    assert run(fresh / "bin" / "warprrf", "--version", cwd=tmp_path) == f"warprrf {PROJECT['version']}"
