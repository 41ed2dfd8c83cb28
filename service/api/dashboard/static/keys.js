// The API key: asked for where the service wants one, kept until the tab is closed, sent with every request.

import { h } from "./dom.js";

const PLACE = "lipserve-key";
let asking = null;

/** The key that requests carry, null where none is needed so far. */
export function key() {
  return sessionStorage.getItem(PLACE);
}

/** Ask for a key; true once one is given. Requests that fail meanwhile wait for the same dialog. */
export function askForKey(reason) {
  asking ??= dialog(reason).finally(() => {
    asking = null;
  });
  return asking;
}

/** Forget the key. */
export function forgetKey() {
  sessionStorage.removeItem(PLACE);
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
      h("p", { id: "key-reason" }, reason || "This service asks for an API key."),
      h("div", { class: "field" }, h("label", { for: "key-input" }, "Key"), input),
      h("p", { class: "hint" }, "Make one on the service's machine: ", h("code", {}, "lipserve keys create --name me --scope admin")),
      h("p", { class: "hint" }, "It is kept until this tab is closed."),
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
      if (given) sessionStorage.setItem(PLACE, given);
      document.dispatchEvent(new Event("keychange"));
      resolve(given !== "");
    });
    document.body.append(box);
    box.showModal();
    input.focus();
  });
}
