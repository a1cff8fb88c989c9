// Jobs on the server: started, polled twice a second, shown or cancelled.

import { h, fill, seconds } from "./dom.js";
import { token } from "./token.js";

export async function ask(path, options = {}) {
  const response = await fetch(path, { ...options, headers: { "x-upright-token": token, ...(options.body ? { "content-type": "application/json" } : {}) } });
  const document = await response.json().catch(() => ({ error: `status ${response.status}` }));
  if (!response.ok) throw new Error(document.error ?? `status ${response.status}`);
  return document;
}

// Runs a job and shows it in `place`; returns its result, or null if it failed or was cancelled. A screen reader says once
// what runs; the seconds are only seen.
export async function run(place, what, words) {
  let job;
  try {
    job = await ask("api/jobs", { method: "POST", body: JSON.stringify(what) });
    const cancel = h("button", { onclick: () => ask(`api/jobs/${job.id}`, { method: "DELETE" }) }, "Cancel");
    const status = h("span", { "aria-hidden": "true" }, " …");
    fill(place, h("p", { class: "busy" }, h("span", { role: "status" }, words), status, " ", cancel));
    while (job.state === "waiting" || job.state === "running") {
      await new Promise((resolve) => setTimeout(resolve, 500));
      job = await ask(`api/jobs/${job.id}`);
      fill(status, job.state === "waiting" ? ", waiting for another job …" : `, ${seconds(job.seconds)} …`);
    }
  } catch (error) {
    fill(place, h("p", { class: "bad", role: "alert" }, `${words}: ${error.message}`));
    return null;
  }
  if (job.state !== "done") {
    fill(place, h("p", { class: "bad", role: "alert" }, `${words}: ${job.state}${job.error ? `: ${job.error}` : ""}`));
    return null;
  }
  fill(place);
  return job.result;
}

export function picker(label, id) {
  const select = h("select", { id });
  return { element: h("label", {}, `${label} `, select), select, async load() {
    const { recordings } = await ask("api/recordings");
    const before = select.value;
    fill(select, recordings.map((each) => h("option", { value: each.name }, each.name)));
    if (recordings.some((each) => each.name === before)) select.value = before;
    return recordings;
  } };
}
