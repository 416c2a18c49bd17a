// Photos against renders: thumbnails, the slider over the picture, frusta that can be clicked.
import { check, element, group } from "./dom.js";

const $ = (id) => document.getElementById(id);

export function showPhotos(viewer, manifest, panel, lights) {
  const frames = manifest.cameras;
  if (!frames.length) return;
  let share = 0.5;
  const buttons = frames.map((f, i) => {
    const picture = f.photo ? [element("img", { src: f.photo, alt: "", loading: "lazy" })] : [];
    return element("button", { "aria-pressed": "false", title: f.name, "data-photo": i, onclick: () => choose(viewer.state.photo === i ? -1 : i) }, ...picture, element("span", {}, f.name));
  });
  const photo = $("photo"), divider = $("divider");

  function place() {
    const on = viewer.state.photo >= 0 && !!frames[viewer.state.photo].photo, c = viewer.canvas;
    photo.hidden = divider.hidden = !on;
    if (!on) return;
    const style = { left: `${c.offsetLeft}px`, top: `${c.offsetTop}px`, width: `${c.clientWidth}px`, height: `${c.clientHeight}px` };
    Object.assign(photo.style, style, { clipPath: `inset(0 ${100 * (1 - share)}% 0 0)` });
    Object.assign(divider.style, { left: `${c.offsetLeft + share * c.clientWidth}px`, top: style.top, height: style.height });
  }
  function choose(i) {
    viewer.lastPhoto = i;
    buttons.forEach((b, k) => b.setAttribute("aria-pressed", k === i));
    if (i >= 0 && frames[i].photo) photo.src = frames[i].photo;
    const own = lights.findIndex((l) => l.photo === i);
    if (i >= 0 && own >= 0) lights.use(own); // a collection: each photo has its own light
    viewer.choosePhoto(i);
    slider.disabled = i < 0;
  }
  const slider = element("input", { type: "range", id: "compare", min: 0, max: 1, step: 0.005, value: share, disabled: true,
    oninput: () => { share = +slider.value; place(); } });
  let down = null;
  viewer.canvas.addEventListener("pointerdown", (e) => { down = [e.offsetX, e.offsetY]; });
  viewer.canvas.addEventListener("pointermove", (e) => {
    if (viewer.state.photo < 0 || !e.buttons) return;
    share = Math.min(Math.max(e.offsetX / viewer.canvas.clientWidth, 0), 1);
    slider.value = share;
    place();
  });
  viewer.canvas.addEventListener("pointerup", (e) => {
    if (!down || !viewer.state.frusta || viewer.state.photo >= 0 || Math.hypot(e.offsetX - down[0], e.offsetY - down[1]) > 4) return;
    const i = viewer.photoAt(e.offsetX, e.offsetY);
    if (i >= 0) choose(i);
  });
  window.addEventListener("keydown", (e) => { if (e.key === "Escape" && viewer.state.photo >= 0) choose(-1); });
  $("home").addEventListener("click", () => choose(-1));
  viewer.onLayout = place;
  viewer.onMatch = () => {
    if (viewer.state.photo >= 0 && viewer.state.view === "shaded" && photo.complete && photo.naturalWidth) viewer.matchPhoto(photo);
  };
  panel.append(group("Photos",
    check("frusta", "show the cameras", false, (v) => viewer.set("frusta", v)),
    element("label", {}, "photo", slider, element("output", {}, "render")),
    element("div", { class: "thumbs" }, ...buttons)));
}
