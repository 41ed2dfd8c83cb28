// The API key: requested when the service requires one, kept until the tab is closed, sent with every request.

import { h } from "./dom.js";

const STORAGE_KEY = "lipserve-key";
let pending = null;

/** Return the current key; null if there is none. */
export function key() {
  return sessionStorage.getItem(STORAGE_KEY);
}

/** Ask for a key and return whether one was entered. Requests that fail meanwhile wait for the same dialog. */
export function askForKey(reason) {
  pending ??= dialog(reason).finally(() => {
    pending = null;
  });
  return pending;
}

/** Forget the key. */
export function forgetKey() {
  sessionStorage.removeItem(STORAGE_KEY);
}

function dialog(reason) {
  return new Promise((resolve) => {
    const input = h("input", {
      id: "key-input",
      type: "password",
      autocomplete: "off",
      spellcheck: "false",
      required: true,
      placeholder: "lip_…",
      "aria-describedby": "key-reason",
    });
    const form = h(
      "form",
      { method: "dialog" },
      h("h2", {}, "API key"),
      h("p", { id: "key-reason" }, reason || "This service requires an API key."),
      h("div", { class: "field" }, h("label", { for: "key-input" }, "Key"), input),
      h("p", { class: "hint" }, "Create one on the service's machine: ", h("code", {}, "lipserve keys create --name me --scope admin")),
      h("p", { class: "hint" }, "The key is kept until you close this tab."),
      h(
        "div",
        { class: "actions" },
        h("button", { class: "primary", value: "use" }, "Use key"),
        h("button", { value: "cancel", formnovalidate: true }, "Cancel"),
      ),
    );
    const box = h("dialog", { "aria-labelledby": "key-title" }, form);
    form.querySelector("h2").id = "key-title";
    box.addEventListener("close", () => {
      const given = box.returnValue === "use" ? input.value.trim() : "";
      box.remove();
      if (given) sessionStorage.setItem(STORAGE_KEY, given);
      document.dispatchEvent(new Event("keychange"));
      resolve(given !== "");
    });
    document.body.append(box);
    box.showModal();
    input.focus();
  });
}
