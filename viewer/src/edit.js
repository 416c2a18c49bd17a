// Masks painted and boxes drawn over photos; saved beside the capture by the local server.
import { choice, element, group, say, slider } from "./dom.js";

const TINT = [60, 110, 255]; // what is off the object

export async function edit(manifest, panel) {
  const canvas = document.getElementById("canvas"), stage = document.getElementById("stage");
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const state = { i: 0, tool: "paint", size: 24, dirty: false, boxes: new Map(), undo: [], circles: manifest.circles };
  let photo = null, mask = null, draft = null; // ImageData, Uint8ClampedArray, box under way
  window.relit.edit = state;

  const load = (url) => new Promise((done, fail) => Object.assign(new Image(), { onload() { done(this); }, onerror: () => fail(new Error(url)), src: url }));
  const pixels = (image, w, h) => {
    const c = element("canvas", { width: w, height: h }).getContext("2d", { willReadFrequently: true });
    c.drawImage(image, 0, 0, w, h);
    return c.getImageData(0, 0, w, h);
  };

  async function open(i) {
    if (state.dirty && !(await save())) return;
    const { w, h, name } = manifest.photos[i], stamp = Date.now();
    const [a, b] = await Promise.all([load(`photo.jpg?i=${i}`), load(`mask.png?i=${i}&t=${stamp}`)]);
    photo = pixels(a, w, h);
    mask = pixels(b, w, h).data.filter((_, k) => k % 4 === 0);
    Object.assign(state, { i, dirty: false, undo: [], ready: true });
    Object.assign(canvas, { width: w, height: h });
    const k = Math.min(stage.clientWidth / w, stage.clientHeight / h, 2);
    Object.assign(canvas.style, { width: `${w * k}px`, height: `${h * k}px` });
    buttons.forEach((x, n) => x.setAttribute("aria-pressed", n === i));
    say(name);
    draw();
  }

  function draw() {
    const out = new ImageData(photo.width, photo.height), p = photo.data, o = out.data;
    for (let k = 0; k < mask.length; k++) {
      const on = 0.35 + (0.65 * mask[k]) / 255;
      for (let c = 0; c < 3; c++) o[4 * k + c] = p[4 * k + c] * on + TINT[c] * (1 - on) * 0.8;
      o[4 * k + 3] = 255;
    }
    context.putImageData(out, 0, 0);
    context.lineWidth = 2;
    const circle = state.circles[state.i], box = draft ?? state.boxes.get(state.i);
    if (circle) { context.strokeStyle = "#ffb454"; context.beginPath(); context.arc(...circle, 0, 7); context.stroke(); }
    if (box) { context.strokeStyle = "#7dff9a"; context.strokeRect(box[0], box[1], box[2] - box[0], box[3] - box[1]); }
  }

  const at = (e) => {
    const r = canvas.getBoundingClientRect();
    return [((e.clientX - r.left) / r.width) * canvas.width, ((e.clientY - r.top) / r.height) * canvas.height];
  };
  function dab([x, y], value) {
    const r = state.size, w = canvas.width, h = canvas.height;
    for (let j = Math.max(0, Math.ceil(y - r)); j < Math.min(h, y + r); j++)
      for (let i = Math.max(0, Math.ceil(x - r)); i < Math.min(w, x + r); i++)
        if ((i + 0.5 - x) ** 2 + (j + 0.5 - y) ** 2 <= r * r) mask[j * w + i] = value;
    state.dirty = true;
  }
  let last = null;
  function stroke(to) {
    const value = state.tool === "paint" ? 255 : 0, n = Math.ceil(Math.hypot(to[0] - last[0], to[1] - last[1]) / Math.max(state.size / 3, 1)) || 1;
    for (let k = 1; k <= n; k++) dab([last[0] + ((to[0] - last[0]) * k) / n, last[1] + ((to[1] - last[1]) * k) / n], value);
    last = to;
    draw();
  }
  canvas.addEventListener("pointerdown", (e) => {
    if (!photo) return;
    canvas.setPointerCapture(e.pointerId);
    last = at(e);
    if (state.tool === "box") draft = [...last, ...last];
    else { state.undo = [...state.undo.slice(-9), mask.slice()]; stroke(last); }
  });
  canvas.addEventListener("pointermove", (e) => {
    if (!last) return;
    if (state.tool === "box") { draft = [draft[0], draft[1], ...at(e)]; draw(); } else stroke(at(e));
  });
  canvas.addEventListener("pointerup", () => {
    if (draft) {
      const [x0, y0, x1, y1] = draft;
      if (Math.abs(x1 - x0) > 3 && Math.abs(y1 - y0) > 3) state.boxes.set(state.i, [Math.min(x0, x1), Math.min(y0, y1), Math.max(x0, x1), Math.max(y0, y1)]);
      draft = null;
    }
    last = null;
    draw();
  });

  async function post(url, body) {
    const answer = await fetch(url, { method: "POST", body }), found = await answer.json();
    if (!answer.ok) throw new Error(found.error);
    return found;
  }
  const guarded = (act) => async () => {
    try { return await act(); } catch (error) { say(error.message, true); return false; }
  };
  const save = guarded(async () => {
    const out = new ImageData(canvas.width, canvas.height);
    for (let k = 0; k < mask.length; k++) { out.data.fill(mask[k], 4 * k, 4 * k + 3); out.data[4 * k + 3] = 255; }
    const c = element("canvas", { width: canvas.width, height: canvas.height });
    c.getContext("2d").putImageData(out, 0, 0);
    await post(`mask?i=${state.i}`, await new Promise((done) => c.toBlob(done, "image/png")));
    state.dirty = false;
    mark(true);
    say("saved");
    return true;
  });
  const forget = guarded(async () => {
    await post(`mask?i=${state.i}`, "");
    state.dirty = false;
    mark(false);
    await open(state.i);
    return true;
  });
  const saveBoxes = guarded(async () => {
    await post("boxes", JSON.stringify([...state.boxes].map(([i, box]) => ({ i, box }))));
    state.circles = (await (await fetch("manifest.json", { cache: "no-store" })).json()).circles;
    say("the object sphere was saved");
    draw();
    return true;
  });
  const cutBox = guarded(async () => {
    const box = state.boxes.get(state.i);
    if (!box) throw new Error("draw a box round the object first");
    await post("cut", JSON.stringify({ i: state.i, box }));
    state.dirty = false;
    mark(true);
    await open(state.i);
    say("the mask in the box was saved");
    return true;
  });
  function mark(on) {
    manifest.photos[state.i].corrected = on;
    buttons[state.i].lastChild.textContent = `${on ? "✓ " : ""}${manifest.photos[state.i].name}`;
  }
  function undo() {
    if (state.undo.length) { mask = state.undo.pop(); state.dirty = true; draw(); }
  }
  window.addEventListener("keydown", (e) => { if ((e.ctrlKey || e.metaKey) && e.key === "z") { e.preventDefault(); undo(); } });
  window.addEventListener("beforeunload", (e) => { if (state.dirty) e.preventDefault(); });

  const buttons = manifest.photos.map((p, i) => element("button", { "data-photo": i, title: p.name, onclick: () => open(i) },
    element("img", { src: `photo.jpg?i=${i}`, alt: "", loading: "lazy" }), element("span", {}, `${p.corrected ? "✓ " : ""}${p.name}`)));
  const tools = [["paint", "add to the object"], ["erase", "take away"], ...(manifest.boxes || manifest.cut ? [["box", "box round the object"]] : [])];
  panel.append(
    group("Mask", element("p", {}, "Blue is off the object. What is saved counts when the capture is opened the next time."),
      choice("tool", "tool", tools, (v) => { state.tool = v; }),
      slider("brush", "brush", { min: 2, max: 120, step: 1, value: state.size }, (v) => `${v} px`, (v) => { state.size = v; }),
      element("button", { id: "undo", onclick: undo }, "undo (Ctrl+Z)"),
      ...(manifest.cut ? [element("button", { id: "cut", onclick: cutBox }, "mask from the box")] : []),
      element("button", { id: "save", onclick: save }, "save this mask"),
      element("button", { id: "forget", onclick: forget }, "back to the automatic mask")),
    ...(manifest.boxes ? [group("Object sphere", element("p", {}, "Draw boxes in two photos from different sides."),
      element("button", { id: "save-boxes", onclick: saveBoxes }, "sphere from the boxes"))] : []),
    group("Photos", element("div", { class: "thumbs" }, ...buttons)));
  await open(0);
  window.relit.ready = true;
}
