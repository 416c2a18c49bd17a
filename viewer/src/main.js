// The page: what is looked at, the panel, and the life of a run that is not over.
import { CHANNELS } from "./channels.js";
import { edit } from "./edit.js";
import { choice, check, element, group, say, slider } from "./dom.js";
import { decodeLight, plainLight } from "./light.js";
import { showLive } from "./live.js";
import { bytesOf, manifest as readManifest } from "./source.js";
import { showPhotos } from "./photos.js";
import { Viewer } from "./viewer.js";
import "./style.css";

const $ = (id) => document.getElementById(id);
const panel = $("panel");

async function main() {
  const manifest = await readManifest();
  document.title = manifest.title;
  panel.append(element("h1", {}, manifest.title), element("p", {}, (manifest.facts ?? []).join(" · ")));
  window.relit = { manifest };
  if (manifest.mode === "edit") return edit(manifest, panel);
  if (!manifest.asset) {
    say("no asset yet: the reconstruction is under way");
    return showLive(panel, manifest, () => location.reload());
  }
  const viewer = new Viewer($("canvas"), $("stage"));
  window.relit.viewer = viewer;
  say("loading");
  await viewer.load(manifest, await bytesOf(manifest.asset.glb));
  const lights = await showLights(viewer, manifest);
  controls(viewer, manifest, lights);
  showPhotos(viewer, manifest, panel, lights);
  if (manifest.live) showLive(panel, manifest, () => location.reload());
  viewer.layout();
  say("");
  const loop = (now) => {
    viewer.frame(now);
    requestAnimationFrame(loop);
  };
  requestAnimationFrame(loop);
  window.relit.ready = true;
}

// The lights of the asset and those that are dropped. `use(index)` chooses one.
async function showLights(viewer, manifest) {
  const lights = manifest.lights.map((l) => ({ ...l, own: true }));
  const select = choice("light", "light", lights.map((l, i) => [i, l.name]), (i) => use(+i));
  const add = (name, entry) => {
    lights.push({ name, ...entry });
    select.querySelector("select").append(element("option", { value: lights.length - 1 }, name));
    return lights.length - 1;
  };
  async function use(index) {
    const entry = lights[index];
    select.querySelector("select").value = index;
    if (!entry.flash) entry.light ??= decodeLight(await bytesOf(entry.url), entry.file);
    if (entry.light) viewer.setLight(entry.light, !!entry.own);
    viewer.setFlash(entry.flash ?? null);
    lights.now = index;
  }
  if (manifest.flash) add("flash at the camera", { flash: manifest.flash, light: plainLight() });
  if (!lights.length) add("plain", { light: plainLight() });
  await use(manifest.flash ? lights.length - 1 : 0);

  const take = async (file) => {
    try {
      if (!/\.(hdr|exr)$/i.test(file.name)) throw new Error("a light is a lat-long .hdr or .exr file");
      await use(add(file.name, { light: decodeLight(await file.arrayBuffer(), file.name) }));
      say("");
    } catch (error) {
      say(`${file.name} cannot be used: ${error.message ?? error}`, true);
    }
  };
  window.addEventListener("dragover", (e) => { e.preventDefault(); $("drop").hidden = false; });
  window.addEventListener("dragleave", (e) => { if (!e.relatedTarget) $("drop").hidden = true; });
  window.addEventListener("drop", (e) => { e.preventDefault(); $("drop").hidden = true; [...e.dataTransfer.files].slice(0, 1).forEach(take); });
  const file = element("input", { type: "file", id: "light-file", accept: ".hdr,.exr", hidden: true, onchange: () => [...file.files].forEach(take) });
  const open = element("button", { id: "light-open", onclick: () => file.click() }, "another light (.hdr, .exr) …");
  return Object.assign(lights, { select, open, file, use });
}

function controls(viewer, manifest, lights) {
  const s = viewer.state;
  panel.append(
    group("Light", lights.select, lights.open, lights.file,
      slider("rotate", "turn", { min: -180, max: 180, step: 1, value: 0 }, (v) => `${v}°`, (v) => viewer.set("rotate", v)),
      slider("exposure", "exposure", { min: -6, max: 6, step: 0.1, value: 0 }, (v) => `${v} EV`, (v) => viewer.set("exposure", 2 ** v)),
      check("show-light", "show it behind the object", false, (v) => viewer.set("showLight", v))),
    group("Picture",
      choice("tone", "tones", [["linear", "linear"], ["photo", "as photographed"], ["neutral", "PBR neutral"]], (v) => {
        viewer.set("tone", v);
        $("exposure").disabled = v === "photo"; // the photos' own exposure
      }),
      choice("view", "channel", [["shaded", "shaded"], ...CHANNELS.map((c) => [c, c]), ["shading", "shading"]], (v) => viewer.set("view", v)),
      viewer.tracer.usable
        ? check("traced", "trace shadows and inter-reflections", s.traced, (v) => viewer.set("traced", v))
        : element("p", {}, "This browser has no float targets: shadows and inter-reflections are left out."),
      ...(viewer.instances.length ? [check("instances", `all ${viewer.instances.length} copies`, false, (v) => viewer.setGeometry(v))] : []),
      element("button", { id: "home", onclick: () => { viewer.choosePhoto(-1); viewer.home(); } }, "whole object")),
  );
  viewer.onProgress = (count) => {
    const text = count >= 0 ? `${count} samples a pixel` : "";
    if (!$("message").classList.contains("error") && $("message").textContent !== text) say(text);
  };
}

main().catch((error) => say(`The page cannot show this run: ${error.message ?? error}`, true));
