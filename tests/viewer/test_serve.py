"""The local server: loopback only, one folder, no foreign hosts or origins; and what the page is
told."""

from __future__ import annotations

import json
import os
import shutil
import socket

import numpy as np
import pytest

from relit.errors import UserError
from relit.run import Run
from relit.viewer.export_html import data_uri
from relit.viewer.manifest import curves, is_held, manifest, status
from relit.viewer.page import SLOT, page_text, page_with
from relit.viewer.photos import write_photos
from relit.viewer.serve import run_server
from support.http_client import ask


def test_it_listens_on_loopback_only(server):
    assert server.server_address[0] == "127.0.0.1"
    here = socket.gethostbyname(socket.gethostname())
    if not here.startswith("127."):
        with pytest.raises(OSError):
            socket.create_connection((here, server.server_address[1]), timeout=2).close()


def test_what_it_serves(server, run_folder):
    code, page, headers = ask(server, "/")
    assert (
        code == 200
        and b"relit-manifest" in page
        and "default-src 'none'" in headers["Content-Security-Policy"]
    )
    assert not any(key.lower().startswith("access-control") for key in headers)
    code, text, _ = ask(server, "/manifest.json")
    found = json.loads(text)
    assert code == 200 and found["title"] == "pawn" and len(found["cameras"]) == 3
    code, glb, _ = ask(server, "/" + found["asset"]["glb"])
    assert code == 200 and glb == (run_folder / "asset/object.glb").read_bytes()
    code, empty, headers = ask(server, "/" + found["asset"]["glb"], method="HEAD")
    assert code == 200 and empty == b"" and int(headers["Content-Length"]) == len(glb)
    code, photo, headers = ask(server, "/" + found["cameras"][0]["photo"])
    assert code == 200 and photo[:2] == b"\xff\xd8" and headers["Content-Type"] == "image/jpeg"


def test_foreign_hosts_and_origins_are_refused(server):
    port = server.server_address[1]
    for headers in (
        {"Host": "evil.example"},
        {"Host": f"evil.example:{port}"},
        {"Host": "127.0.0.1"},
        {"Host": f"127.0.0.1:{port + 1}"},
        {"Host": ""},
        {"Origin": "http://evil.example"},
        {"Origin": f"http://127.0.0.1:{port + 1}"},
        {"Origin": "null"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ):
        for path in ("/", "/manifest.json", "/files/asset/object.glb"):
            assert ask(server, path, **headers)[0] == 403, (path, headers)
    for headers in (
        {"Host": f"localhost:{port}"},
        {"Origin": f"http://127.0.0.1:{port}"},
        {"Sec_Fetch_Site": "same-origin"},
    ):
        assert ask(server, "/manifest.json", **headers)[0] == 200
    assert ask(server, "/anything", method="POST", body=b"{}")[0] == 403
    assert (
        ask(server, "/manifest.json", method="POST", body=b"{}", Origin=f"http://127.0.0.1:{port}")[
            0
        ]
        == 403
    )
    assert ask(server, "/", method="DELETE")[0] == 501


def test_nothing_outside_the_folder(server, run_folder):
    secret = run_folder.parent / "secret.txt"
    secret.write_text("outside")
    link, inner = run_folder / "leads-out", run_folder / "leads-in"
    link.symlink_to(secret)
    inner.symlink_to(run_folder / "config.toml")
    try:
        for name in (
            "../secret.txt",
            "%2e%2e/secret.txt",
            "..%2fsecret.txt",
            "asset/../../secret.txt",
            "asset/%2e%2e/%2e%2e/secret.txt",
            "leads-out",
            "/etc/passwd",
            "%2fetc%2fpasswd",
            "..\\secret.txt",
            "asset",
            "",
            ".",
            "a\0b".replace("\0", "%00"),
            "x" * 5000,
        ):
            code, content, _ = ask(server, "/files/" + name)
            assert code in (403, 404) and b"outside" not in content and b"root:" not in content, (
                name
            )
        assert ask(server, "/files/leads-in")[0] == 200
    finally:
        link.unlink()
        inner.unlink()
        secret.unlink()


def test_two_servers_on_one_port(server, run_folder):
    with pytest.raises(UserError, match="port") as error:
        run_server(run_folder, server.server_address[1])
    assert error.value.code == 5


def test_folders_that_are_no_run(built, tmp_path, run_folder):
    with pytest.raises(UserError, match="not an asset folder"):
        run_server(tmp_path)
    broken = tmp_path / "broken"
    shutil.copytree(run_folder, broken)
    head = json.loads((broken / "asset/asset.json").read_text())
    for spoilt in (
        {**head, "world_from_asset": "north"},
        {**head, "world_from_asset": [[1, 2], [3, 4]]},
    ):
        (broken / "asset/asset.json").write_text(json.dumps(spoilt))
        with pytest.raises(UserError, match="world_from_asset"):
            run_server(broken)
    (broken / "asset/asset.json").write_text(json.dumps(head))
    (broken / "asset/object.glb").unlink()
    with pytest.raises(UserError, match=r"object\.glb"):
        run_server(broken)


def test_data_that_would_end_the_script(built):
    text = page_with({"title": "</script><script>alert(1)</script><!--"})
    assert (
        text.count("</script>") == page_text().count("</script>")
        and "alert(1)</script>" not in text
    )
    start = text.index(">", text.index('id="relit-manifest"')) + 1
    assert (
        json.loads(text[start : text.index("</script>", start)])["title"]
        == "</script><script>alert(1)</script><!--"
    )
    assert SLOT not in text


@pytest.mark.slow
def test_names_in_the_index_cannot_leave_the_folder(run_folder, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(run_folder, run)
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    (run / "photos/index.json").write_text(
        json.dumps({"photos": {"images/p0.png": "../../secret.jpg", "images/p1.png": 3}})
    )
    assert [c["photo"] for c in manifest(run, data_uri, live=False)["cameras"]] == [None] * 3


def test_instances_lights_and_flash_are_told(run_folder, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(run_folder, run)
    pose = np.eye(4).tolist()
    listed = [
        {"label": 1, "world_from_object": pose},
        {"label": 2, "world_from_object": pose, "registered": False},
        {"label": 3},
    ]
    (run / "asset/instances.json").write_text(json.dumps({"instances": listed}))
    (run / "asset/lights/flash.json").write_text(
        json.dumps({"offset": [0, 0, 0], "intensity": [1, 1, 1]})
    )
    shutil.copy(run / "asset/lights/environment.exr", run / "asset/lights/photo_0001.exr")
    found = manifest(run, lambda p: p.name, live=False)
    assert found["asset"]["instances"] == [pose] and found["flash"]["offset"] == [0, 0, 0]
    assert [(light["url"], light["photo"]) for light in found["lights"]] == [
        ("environment.exr", None),
        ("photo_0001.exr", 1),
    ]


def test_status_of_a_run(tmp_path):
    run = Run.open(tmp_path / "run", {"input": "x"})
    assert is_held(tmp_path / "run")
    with run.stage("volume", steps=10) as stage:
        stage.step(5, image=0.5)
        said = status(tmp_path / "run", lambda p: p.name)
        assert said["running"] and said["now"]["step"] == 5 and said["now"]["of"] == 10
        assert said["now"]["left"] == pytest.approx(said["now"]["seconds"])
    run.close()
    said = status(tmp_path / "run", lambda p: p.name)
    assert (
        not said["running"]
        and said["now"] is None
        and [s["name"] for s in said["stages"]] == ["volume"]
    )


def test_long_curves_are_thinned():
    records = [
        {"stage": "s", "step": i, "of": 5000, "seconds": 1.0, "image": 1.0, "bad": None}
        for i in range(5000)
    ]
    (only,) = curves(records)
    assert only["name"] == "image" and 100 <= len(only["points"]) <= 200


def test_copies_of_photos(tmp_path):
    from relit.scene import Capture, Photo, Pixels

    image = np.zeros((30, 2000, 3), np.float32)
    image[:, 1000:] = 1
    photo = Photo("images/ä b.png", lambda: Pixels(image), 2000, 30)
    write_photos(tmp_path, Capture(tmp_path, "photos", (photo, photo)))
    folder = write_photos(tmp_path, Capture(tmp_path, "photos", (photo,)))
    from relit.images import read_image

    assert sorted(os.listdir(folder)) == ["0000.jpg", "index.json"]
    copy = read_image(folder / "0000.jpg").rgb
    assert copy.shape == (15, 1024, 3) and copy[:, :500].max() < 0.01 and copy[:, 524:].min() > 0.9
