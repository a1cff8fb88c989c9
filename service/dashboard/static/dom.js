// Elements made of text and other elements. Nothing on this page parses markup: the contents of messages and file names
// are always shown as text.

export const $ = (id) => document.getElementById(id);

export function h(tag, props = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(props)) {
    if (value === undefined || value === null || value === false) continue;
    if (key === "class") element.className = value;
    else if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else element.setAttribute(key, value === true ? "" : String(value));
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined).map((child) =>
    child instanceof Node ? child : document.createTextNode(String(child))));
  return element;
}

export function fill(element, ...children) {
  element.replaceChildren(...children.flat(Infinity).filter((child) => child !== null && child !== undefined).map((child) =>
    child instanceof Node ? child : document.createTextNode(String(child))));
  return element;
}

export function text(element, value) {
  const wanted = String(value);
  if (element.textContent !== wanted) element.textContent = wanted;
}

// A number in readable form, or a dash if it is not a number.
export function number(value, digits = 4) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "–";
  if (value !== 0 && (Math.abs(value) >= 1e6 || Math.abs(value) < 1e-3)) return value.toExponential(Math.max(0, digits - 2));
  return String(Number(value.toPrecision(digits)));
}

// A unit with superscripts.
export const unit = (words) => String(words ?? "").replace(/\^(-?[0-9])/g, (_, power) => power.replace("-", "⁻").replace(/[0-9]/, (digit) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[digit]));

export function seconds(value) {
  return typeof value === "number" && Number.isFinite(value) ? `${Math.max(0, Math.round(value))} s` : "–";
}

// A name may be wrapped after its underscores.
const breakable = (cell) => (typeof cell === "string" ? cell.split(/(?<=_)/).flatMap((part, place) => (place ? [h("wbr"), part] : [part])) : cell);

export function table(headings, rows, caption) {
  return h("div", { class: "scroll" }, h("table", {},
    caption ? h("caption", {}, caption) : null,
    h("thead", {}, h("tr", {}, headings.map((heading) => h("th", { scope: "col" }, heading)))),
    h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, place) =>
      h(place === 0 ? "th" : "td", place === 0 ? { scope: "row" } : {}, place === 0 ? breakable(cell) : cell)))))));
}
