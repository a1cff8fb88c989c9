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
