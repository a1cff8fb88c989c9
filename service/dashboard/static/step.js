// A step of the commissioning: what it is for, its limits, and what was found. All of it is text from messages.

import { h, table } from "./dom.js";
import { plain, unit } from "./numbers.js";

const BADGES = {
  open: ["open", ""], waiting: ["waiting", ""], accepted: ["✓ accepted", "good"],
  not_accepted: ["✗ not accepted", "bad"], failed: ["✗ failed", "bad"], skipped: ["skipped", "warn"],
};

export const isDone = (step) => step.state === "accepted" || step.state === "skipped";

export function badge(step, active = false) {
  const [words, kind] = active ? ["under way", "active"] : BADGES[step.state] ?? [step.state, ""];
  return h("span", { class: "badge", "data-kind": kind, "data-state": step.state }, words);
}

const quantity = ({ value, std, unit: its }) => plain(value, std, its);

// What was measured, and whether it is within its limits, in words and not only by colour.
function measured(each) {
  if (typeof each.value !== "number") return h("span", { class: "bad" }, "✗ not known");
  return h("span", { class: each.within ? "good" : "bad", "data-within": String(each.within) },
    quantity(each), " ", h("span", { class: "verdict" }, each.within ? "✓\u00a0within" : "✗\u00a0outside"));
}

// The limits; with what was measured once the step has been carried out.
export function acceptance(step) {
  if (!step.acceptance.length) return null;
  const judged = step.acceptance.some((each) => typeof each.within === "boolean");
  const rows = step.acceptance.map((each) => [each.title, unit(each.limits), ...(judged ? [measured(each)] : [])]);
  return h("div", { class: "acceptance" }, table(["Accepted if", "is", ...(judged ? ["Found"] : [])], rows));
}

function remedies(step) {
  const outside = step.acceptance.filter((each) => each.within === false);
  if (!outside.length) return null;
  return h("div", { class: "remedies" }, h("h3", {}, "What to do"),
    h("ul", {}, outside.map((each) => h("li", {}, h("strong", {}, `${each.title}: `), each.remedy))));
}

function further(step) {
  const known = new Set(step.acceptance.map((each) => each.quantity));
  const rows = Object.entries(step.numbers).filter(([name]) => !known.has(name)).map(([name, each]) => [name, quantity(each)]);
  return rows.length ? h("details", {}, h("summary", {}, rows.length === 1 ? "One further number" : `${rows.length} further numbers`), table(["Number", "Found"], rows)) : null;
}

const last = (path) => path.split("/").pop();

// A file as a link if it is a page.
export function file(path) {
  return path.endsWith(".html") ? h("a", { href: `commissioning/${encodeURIComponent(last(path))}`, target: "_blank", rel: "noopener" }, last(path)) : last(path);
}

function kept(step) {
  const recording = last(step.recording);
  const files = Object.keys(step.files);
  const lines = [
    recording ? ["Recording", h("a", { href: `api/recordings/${encodeURIComponent(recording)}/recording`, download: "" }, recording)] : null,
    files.length ? ["Files", h("ul", { class: "plain" }, files.map((path) => h("li", {}, file(path))))] : null,
    step.date ? ["When", `${step.date} UTC${step.by ? `, by ${step.by}` : ""}`] : null,
  ].filter(Boolean);
  return lines.length ? h("dl", { class: "kept" }, lines.map(([name, each]) => [h("dt", {}, name), h("dd", {}, each)])) : null;
}

// What came of a step: empty before it was carried out.
export function found(step) {
  return [
    step.reason ? h("p", { class: step.state === "failed" ? "bad" : "" }, step.state === "skipped" ? `Skipped: ${step.reason}` : step.reason) : null,
    step.text.map((words) => h("p", {}, words)), remedies(step), further(step), kept(step),
  ];
}

export const wasCarriedOut = (step) => Boolean(step.date);

// Why it is done; folded once there is something more important to read.
export function purpose(step, folded = false) {
  const words = [h("p", {}, step.why), h("p", {}, h("strong", {}, "Why now: "), step.why_now)];
  return folded ? h("details", {}, h("summary", {}, "Why this step"), words) : words;
}

// What a person does, or makes sure of, before.
export function prepare(step) {
  return step.prepare ? h("div", { class: "prepare" }, h("h3", {}, "Before you begin"), h("p", {}, step.prepare)) : null;
}
