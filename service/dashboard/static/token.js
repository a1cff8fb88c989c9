// The token of the page's address (#token=...). Requests that change something need it. It is kept for this host and port,
// and taken out of the address; a server never sees the part after the #.

export const token = take() ?? kept();
addEventListener("hashchange", () => take() && location.reload());

function take() {
  const given = /^#token=([\w-]+)&?/.exec(location.hash);
  if (!given) return null;
  try {
    localStorage.setItem("token", given[1]);
  } catch { /* storage is switched off: the token is known until the page is loaded again */ }
  history.replaceState(null, "", `#${location.hash.slice(given[0].length)}`);
  return given[1];
}

function kept() {
  try {
    return localStorage.getItem("token") ?? "";
  } catch {
    return "";
  }
}
