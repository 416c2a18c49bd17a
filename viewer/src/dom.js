// Small builders for the panel.
export function element(tag, attributes = {}, ...children) {
  const e = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) e.addEventListener(key.slice(2), value);
    else if (value === true) e.setAttribute(key, "");
    else if (value !== false && value != null) e.setAttribute(key, value);
  }
  e.append(...children);
  return e;
}

export const group = (title, ...children) => element("fieldset", {}, element("legend", {}, title), ...children);

export function slider(id, text, { min, max, step, value }, readable, act) {
  const out = element("output", {}, readable(value));
  const input = element("input", { type: "range", id, min, max, step, value });
  input.addEventListener("input", () => { out.textContent = readable(+input.value); act(+input.value); });
  return element("label", {}, text, input, out);
}

export function choice(id, text, options, act) {
  const select = element("select", { id, onchange: () => act(select.value) }, ...options.map(([value, name]) => element("option", { value }, name)));
  return element("label", {}, text, select);
}

export const check = (id, text, checked, act) => {
  const input = element("input", { type: "checkbox", id, checked, onchange: () => act(input.checked) });
  return element("label", { class: "check" }, input, text);
};

export function say(text, error = false) {
  const m = document.getElementById("message");
  m.textContent = text;
  m.classList.toggle("error", error);
}
