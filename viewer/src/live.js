// A run that is not over: stages, losses, previews, time left. Asks the server every other second.
import { element, group } from "./dom.js";

const time = (s) => (s >= 3600 ? `${Math.floor(s / 3600)} h ${Math.round((s % 3600) / 60)} min` : s >= 60 ? `${Math.floor(s / 60)} min ${Math.round(s % 60)} s` : `${Math.round(s)} s`);

function curve(points) {
  const ys = points.map((p) => Math.log10(Math.max(p[1], 1e-9))), low = Math.min(...ys), high = Math.max(...ys);
  const x0 = points[0][0], x1 = Math.max(points.at(-1)[0], x0 + 1);
  const d = points.map((p, i) => `${i ? "L" : "M"}${(100 * (p[0] - x0)) / (x1 - x0)} ${38 - (36 * (ys[i] - low)) / (high - low || 1)}`).join("");
  const ns = "http://www.w3.org/2000/svg", svg = document.createElementNS(ns, "svg"), path = document.createElementNS(ns, "path");
  svg.setAttribute("viewBox", "0 0 100 40");
  svg.setAttribute("preserveAspectRatio", "none");
  svg.setAttribute("class", "curve");
  path.setAttribute("d", d);
  svg.append(path);
  return svg;
}

export function showLive(panel, manifest, finished) {
  const body = element("div", { id: "live" });
  panel.append(group("Reconstruction", body));
  const had = !!manifest.asset;
  async function ask() {
    let status;
    try {
      status = await (await fetch("status.json", { cache: "no-store" })).json();
    } catch {
      body.replaceChildren(element("p", {}, "the server does not answer"));
      return setTimeout(ask, 5000);
    }
    if (status.asset && !had) return finished();
    draw(status);
    if (status.running || !status.asset) setTimeout(ask, 2000);
  }
  function draw(status) {
    const rows = status.stages.map((s) => element("p", {}, `${s.title ?? s.name}: ${time(s.seconds)}`));
    const now = status.now;
    if (now) {
      const share = now.of ? now.step / now.of : 0;
      rows.push(element("p", { id: "now" }, `${now.stage}: step ${now.step}${now.of ? ` of ${now.of}` : ""}, ${time(now.seconds)}${now.left != null ? `, about ${time(now.left)} left in this stage` : ""}`));
      const fill = element("i");
      fill.style.width = `${100 * share}%`;
      rows.push(element("div", { class: "bar" }, fill));
    }
    if (!status.running && !status.asset) rows.push(element("p", {}, "no process works on this run; the same relit reconstruct command takes it up again"));
    for (const { stage, name, points } of status.curves)
      if (points.length > 1) rows.push(element("p", {}, `${stage}, ${name}: ${points.at(-1)[1].toPrecision(3)}`), curve(points));
    for (const p of status.previews) {
      const said = `${p.name}: a photo, and what stands for it now`;
      rows.push(element("figure", { class: "preview" }, element("img", { src: p.url, alt: said }), element("figcaption", {}, said)));
    }
    body.replaceChildren(...rows);
    if (!had && status.previews.length) { // there is nothing else to look at yet
      const newest = document.getElementById("photo");
      newest.src = status.previews[0].url;
      newest.style.width = "92%";
      newest.hidden = false;
    }
  }
  ask();
}
