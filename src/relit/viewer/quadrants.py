"""`relit quadrants PHOTOS`: the page, or the terminal, that asks where each photo of a collection
was taken from: quadrants.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from urllib.parse import parse_qs

from relit.capture.readers.samurai import QUADRANTS, direction_of, quadrant_of
from relit.errors import UserError
from relit.files import write_text
from relit.images import encode_jpeg
from relit.scene import Capture, Photo
from relit.viewer.photos import shrunk
from relit.viewer.serve import Server, open_port

SIDE = 900  # pixels, longest side of what is shown
KEYS = {"a": "Left", "d": "Right", "w": "Above", "s": "Below", "f": "Front", "b": "Back"}
AXES = (("Left", "Right"), ("Above", "Below"), ("Front", "Back"))
EXPLAINED = "where did the camera stand? a left, d right, w above, s below, f in front, b behind (of the object, its front facing you)"


def answers_of(keys: str) -> list[str]:
    """SAMURAI's three answers of typed keys, such as 'af': Center where no key of an axis was
    typed. Raises UserError for other keys, for two sides of one axis, and for none at all."""
    words = []
    for key in keys.replace(" ", "").lower():
        if key not in KEYS:
            raise UserError(f"'{key}' is no key of a quadrant", fix=EXPLAINED)
        words.append(KEYS[key])
    out = []
    for axis in AXES:
        said = [w for w in axis if w in words]
        if len(said) > 1:
            raise UserError(
                f"{said[0]} and {said[1]} contradict each other",
                fix="type one of them, or neither for the middle",
            )
        out.append(said[0] if said else "Center")
    direction_of(out)  # refuses three times Center
    return out


def keys_of(answers: list[str]) -> str:
    """The keys of three answers: the inverse of `answers_of`."""
    return "".join(key for key, word in KEYS.items() if word in answers)


def read_answers(root: Path) -> dict[str, list[str]]:
    """The answers that are there: name of the file -> three words. Empty where there are none, or
    none that can be read."""
    try:
        frames = json.loads((root / QUADRANTS).read_text(encoding="utf-8"))["frames"]
        return {Path(f["image_name"]).name: list(f["quadrant"]) for f in frames}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def write_answers(root: Path, answers: dict[str, list[str]]) -> Path:
    """quadrants.json, sorted by name; returns its path."""
    frames = [{"image_name": name, "quadrant": answers[name]} for name in sorted(answers)]
    write_text(root / QUADRANTS, json.dumps({"frames": frames}, indent=1) + "\n")
    return root / QUADRANTS


def guesses_of(run: str | Path) -> dict[str, list[str]]:
    """What a run's recovered cameras would answer: name of the file -> three words. Without hints a
    run's frame is that of the photo that
    it grew from, taken for the front: then the guesses are right up to one turn of the whole.
    Raises UserError."""
    from relit.asset.asset import find_asset, read_cameras

    cameras = read_cameras(find_asset(run) / "cameras.json")
    return {Path(name).name: quadrant_of(camera.centre) for name, camera in cameras}


def in_order(capture: Capture) -> list[Photo]:
    """All photos by their names, those that are set aside among the others: neighbours were mostly
    taken one after the other."""
    return sorted((*capture.photos, *capture.held_out), key=lambda p: p.name)


def ask_in_terminal(
    capture: Capture,
    ask: Callable[[str], str] = input,
    say: Callable[[str], None] = print,
    guesses: Mapping[str, list[str]] | None = None,
) -> Path:
    """Ask for every photo that has no answer yet; an empty line takes the guess, or skips the photo
    where there is none; 'q' stops. Each answer is saved at once."""
    root, guesses = capture.folder, guesses or {}
    answers = read_answers(root)
    say(EXPLAINED)
    todo = [p.name for p in in_order(capture) if Path(p.name).name not in answers]
    for i, name in enumerate(todo):
        guess = guesses.get(Path(name).name)
        offer = "" if guess is None else f" [{' '.join(guess)}]"
        while True:
            try:
                typed = ask(f"{name} ({i + 1} of {len(todo)}){offer}: ").strip()
            except EOFError:
                typed = "q"
            if typed == "" and guess is not None:
                typed = keys_of(guess)
            if typed in ("", "q"):
                break
            try:
                answers[Path(name).name] = answers_of(typed)
            except UserError as error:
                say(str(error))
                continue
            write_answers(root, answers)
            break
        if typed == "q":
            break
    return write_answers(root, answers)


def quadrant_server(
    capture: Capture, port: int = 0, guesses: Mapping[str, list[str]] | None = None
) -> Server:
    """A server of the page; every answer is saved at once. guesses: shown as chosen, until Enter
    makes them answers."""
    photos, root, guesses = in_order(capture), capture.folder, guesses or {}

    def state() -> dict:
        answers = read_answers(root)
        names = [(p.name, Path(p.name).name) for p in photos]
        listed = [
            {"name": shown, "answer": answers.get(file), "guess": guesses.get(file)}
            for shown, file in names
        ]
        return {"photos": listed, "explained": EXPLAINED}

    def photo(query: str) -> tuple[bytes, str]:
        i = int(parse_qs(query)["i"][0])
        if not 0 <= i < len(photos):
            raise LookupError(f"there is no photo {i}")
        return encode_jpeg(shrunk(photos[i].load().rgb, SIDE)), "image/jpeg"

    def keep(body: bytes, _: str) -> dict:
        said = json.loads(body)
        i = int(said["i"])
        if not 0 <= i < len(photos):
            raise LookupError(f"there is no photo {i}")
        answers = read_answers(root)
        answers[Path(photos[i].name).name] = answers_of(str(said["keys"]))
        write_answers(root, answers)
        return {"answer": answers[Path(photos[i].name).name], "done": len(answers)}

    server = open_port(
        lambda: Server(root, {"quadrants": state}, {"answer": keep}, {"photo.jpg": photo}, port),
        port,
    )
    server.page = PAGE.encode()
    return server


PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Quadrants</title><link rel="icon" href="data:,">
<style>
body { margin: 0; font: 16px/1.4 system-ui, sans-serif; background: #1b1d20; color: #e8e8e8; text-align: center }
img { max-width: 96vw; max-height: 66vh; min-height: 8em; margin: 1em auto; display: block }
button { font: inherit; margin: .2em; padding: .4em .9em; border: 1px solid #777; border-radius: .4em; background: #2b2e33; color: inherit }
button[aria-pressed=true] { background: #3a6ea5; border-color: #9cf }
#note { min-height: 1.5em; color: #fc8 }
</style>
<p id="what"></p><img id="photo" alt="the photo that is asked about">
<div id="keys"></div><div><button id="back">&larr; back</button> <button id="next">Enter: save, next</button></div><p id="note"></p>
<script>
const keys = {a: "Left", d: "Right", w: "Above", s: "Below", f: "Front", b: "Back"};
const axes = ["ad", "ws", "fb"];
let photos = [], at = 0, chosen = new Set();
const $ = id => document.getElementById(id);
for (const [key, word] of Object.entries(keys)) {
  const b = document.createElement("button");
  b.textContent = key + " " + word; b.dataset.key = key; b.onclick = () => toggle(key); $("keys").append(b);
}
function toggle(key) {
  const axis = axes.find(a => a.includes(key)), on = !chosen.has(key);
  for (const k of axis) chosen.delete(k);
  if (on) chosen.add(key);
  draw();
}
function draw() {
  for (const b of $("keys").children) b.setAttribute("aria-pressed", chosen.has(b.dataset.key));
}
function picture(i) {  // one element each: while a photo loads, no other stands in its place
  if (!photos[i].image) photos[i].image = Object.assign(new Image(), {id: "photo", alt: "loading", src: "photo.jpg?i=" + i});
  return photos[i].image;
}
function show(i) {
  at = Math.max(0, Math.min(photos.length - 1, i));
  const p = photos[at];
  chosen = new Set(Object.keys(keys).filter(k => (p.answer || p.guess || []).includes(keys[k])));
  $("photo").replaceWith(picture(at));
  const following = at + 1;
  if (following < photos.length) picture(at).decode().catch(() => {}).then(() => picture(following));
  const done = photos.filter(q => q.answer).length;
  const where = (at + 1) + " of " + photos.length + ", " + done + " answered", hint = !p.answer && p.guess ? " (a guess is shown)" : "";
  $("what").textContent = p.name + " (" + where + "): where did the camera stand?" + hint;
  draw();
}
async function save() {
  const reply = await fetch("answer", {method: "POST", body: JSON.stringify({i: at, keys: [...chosen].join("")})});
  const said = await reply.json();
  if (said.error) { $("note").textContent = said.error; return; }
  photos[at].answer = said.answer; $("note").textContent = "";
  if (photos.every(p => p.answer)) $("note").textContent = "All answered. This page can be closed.";
  show(at + 1);
}
$("next").onclick = save; $("back").onclick = () => show(at - 1);
addEventListener("keydown", e => {
  if (e.ctrlKey || e.metaKey || e.altKey) return;
  const key = e.key.toLowerCase();
  if (key in keys) toggle(key); else if (key === "enter") { e.preventDefault(); save(); }
  else if (key === "arrowleft") show(at - 1); else if (key === "arrowright") show(at + 1);
});
fetch("quadrants").then(r => r.json()).then(s => {
  photos = s.photos;
  const first = photos.findIndex(p => !p.answer);
  show(first < 0 ? 0 : first);
});
</script></html>
"""
