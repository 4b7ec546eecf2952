"""A file is whole or not there, and not what it was written as is an error."""

import io
import os
import resource
import signal
import stat
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from warprrf import files, netcdf_files, tensor_files


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file(tmp_path, error):
    path = tmp_path / "kept.txt"
    path.write_text("old")

    def broken(file):
        file.write_text("half")
        raise error

    with pytest.raises(type(error)):
        files.write_atomically(path, broken)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_is_written_beside_its_place_under_its_suffix(tmp_path):
    path = tmp_path / "new" / "folder" / "field.v2.nc"
    seen = []
    files.write_atomically(
        path, lambda file: (seen.append(file), file.write_bytes(b"data"), path.exists() and 1 / 0)
    )
    assert path.read_bytes() == b"data"
    assert seen[0].parent == path.parent and seen[0].suffix == ".nc" and not seen[0].exists()


def test_names_as_long_as_the_system_takes_them_are_written(tmp_path):
    for name in ("ö" * 125 + ".nc", "a." + "b" * 250):
        files.write_text(tmp_path / name, "text")
        assert (tmp_path / name).read_text() == "text"


def test_a_full_disk_is_an_error_that_names_the_file_and_leaves_the_old_one(tmp_path):
    path = tmp_path / "kept.bin"
    path.write_bytes(b"old")
    handler, limit = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))
        with pytest.raises(OSError, match=r"kept\.bin"):
            files.write_bytes(path, bytes(5000), seal=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["kept.bin"]


@pytest.mark.parametrize("mask", [0o022, 0o027, 0o002])
def test_files_have_the_rights_that_the_umask_leaves(tmp_path, mask):
    before = os.umask(mask)
    try:
        files.write_bytes(tmp_path / "bytes", b"")
        tensor_files.write(tmp_path / "tensors", {"x": np.zeros(3)}, {})
    finally:
        os.umask(before)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert modes == {"bytes": 0o666 & ~mask, "tensors": 0o666 & ~mask}


def test_threads_may_write_one_file(tmp_path):
    path = tmp_path / "shared"
    contents = [bytes([k]) * 100_000 for k in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda k: files.write_bytes(path, contents[k % 8]), range(200)))
    assert path.read_bytes() in contents and os.listdir(tmp_path) == ["shared"]


def test_partial_files_of_killed_processes_are_removed_and_those_of_living_ones_stay(tmp_path):
    killed = (
        "import os, sys, time; from pathlib import Path; from warprrf.files import write_atomically;"
        "write_atomically(sys.argv[1], lambda p: (p.write_text('half'), print(p.name, flush=True), time.sleep(60)))"
    )
    command = [sys.executable, "-c", killed, tmp_path / "a.nc"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        name = process.stdout.readline().strip()
        files.write_text(tmp_path / "b.txt", "")
        assert sorted(os.listdir(tmp_path)) == sorted([name, "b.txt"])
        process.kill()
    other_machine = f".a.00000000-{process.pid}-00000000.partial.nc"
    (tmp_path / other_machine).touch()
    folder = tmp_path / name.replace(".nc", "")
    (folder / "inside").mkdir(parents=True)
    files.write_text(tmp_path / "b.txt", "")
    assert sorted(os.listdir(tmp_path)) == sorted([other_machine, "b.txt"])


def test_a_path_without_a_name_is_refused():
    with pytest.raises(ValueError, match="path: got ''"):
        files.partial_path("")


def test_text_and_arrays_come_back(tmp_path):
    files.write_text(tmp_path / "a.txt", "größer")
    assert (tmp_path / "a.txt").read_bytes() == "größer".encode()
    held = {"x": np.arange(3), "y": np.eye(2, order="F"), "z": np.array("text"), "none": np.zeros((0, 3))}
    for compress in (True, False):
        files.write_arrays(tmp_path / "a.bin", held, compress=compress)
        found = files.read_arrays(tmp_path / "a.bin")
        assert list(found) == list(held)
        for name, array in held.items():
            np.testing.assert_array_equal(found[name], array)
            assert found[name].dtype == array.dtype
    with pytest.raises(TypeError, match="^x: got an array of Python objects"):
        files.write_arrays(tmp_path / "a.bin", {"x": np.array([None])})


def test_arrays_that_state_more_than_they_hold_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    pickled = io.BytesIO()
    np.save(pickled, np.array([{}]), allow_pickle=True)
    for content in (header.getvalue(), pickled.getvalue(), b"", b"\x93NUMPY\x09\x00"):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("x.npy", content)
        with pytest.raises(ValueError, match=r"a\.npz: damaged, or no NPZ file"):
            files.read_arrays(path)


def test_a_seal_is_seen(tmp_path):
    """What damage does to sealed files, arrays and JSON is in tests/fuzz."""
    path = tmp_path / "a"
    for data in (b"", b"content", bytes(3_000_000)):
        files.write_bytes(path, data, seal=True)
        assert files.check_seal(path) and path.read_bytes().startswith(data)
        files.write_bytes(path, data)
        assert not files.check_seal(path)
    with pytest.raises(FileNotFoundError, match="missing"):
        files.check_seal(tmp_path / "missing")
    value = {"b": [1, 2.5, 1e-30, None, "ö"], "a": {"c": True}}
    for seal in (True, False):
        files.write_json(path, value, seal=seal)
        assert files.read_json(path) == value


@pytest.mark.parametrize("text", ["[5]", "5", "", "{", "[" * 100_000, '{"a": NaN}', '{"a": 1e999}', "\xff"])
def test_json_that_is_no_mapping_of_finite_numbers_is_refused(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=r"a\.json: "):
        files.read_json(path)


def test_a_folder_takes_its_place_whole_or_not_at_all(tmp_path):
    folder = tmp_path / "made"
    for text in ("first", "second"):
        with files.folder_in_place(folder) as part:
            (part / "a").write_text(text)
        assert (folder / "a").read_text() == text
    with pytest.raises(ZeroDivisionError), files.folder_in_place(folder) as part:
        (part / "a").write_text("third")
        raise ZeroDivisionError
    assert (folder / "a").read_text() == "second" and os.listdir(tmp_path) == ["made"]


def test_fields_come_back_from_codes_and_parts():
    variables = {
        "kind": netcdf_files.Variable(("n",), codes=("", "los")),
        "seen": netcdf_files.Variable(("n",), codes=(False, True)),
        "gain_real": netcdf_files.Variable(("n",), field="gain", is_part=True),
        "gain_imag": netcdf_files.Variable(("n",), field="gain", is_part=True),
        "at": netcdf_files.Variable(("xyz",), field="place"),
        "each_at": netcdf_files.Variable(("n", "xyz"), field="place"),
    }
    fields = {
        "kind": np.array(["los", ""]), "seen": np.array([True, False]), "gain": np.array([1 + 2j, 3j]),
        "place": np.zeros((2, 3)),
    }  # fmt: skip
    arrays = netcdf_files.encoded(fields, variables)
    assert list(arrays) == ["kind", "seen", "gain_real", "gain_imag", "each_at"]
    assert arrays["kind"].dtype == np.int8
    found = netcdf_files.decoded(arrays, variables)
    assert found.keys() == fields.keys()
    for name, value in fields.items():
        np.testing.assert_array_equal(found[name], value)
    for bad in ([2, 0], [-1, 0], [0.5, 0.0], [np.nan, 0.0]):
        with pytest.raises(ValueError, match="^kind: got .*, expected whole numbers from 0 to 1"):
            netcdf_files.decoded(arrays | {"kind": np.array(bad)}, variables)
    with pytest.raises(KeyError, match="gain_imag"):
        netcdf_files.decoded({"gain_real": arrays["gain_real"]}, variables)
