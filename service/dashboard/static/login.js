// Asks for user and password if the broker refused them; only this page keeps them, as long as it is open.

import { h, fill, $ } from "./dom.js";

export function login(link, notice) {
  if ($("login")) return;
  link.socket.end(true);
  const user = h("input", { name: "user", autocomplete: "username", value: link.login.username ?? "", required: true });
  const password = h("input", { name: "password", type: "password", autocomplete: "current-password", required: true });
  const form = h("form", { id: "login", onsubmit: (event) => {
    event.preventDefault();
    link.login = { username: user.value, password: password.value };
    notice("");
    link.open();
  } },
  h("strong", {}, "The broker refused this user or password. "),
  h("span", { class: "row" }, h("label", {}, "User ", user), h("label", {}, "Password ", password), h("button", { class: "primary" }, "Connect")));
  fill($("notice"), form);
  $("notice").hidden = false;
  (user.value ? password : user).focus();
}
