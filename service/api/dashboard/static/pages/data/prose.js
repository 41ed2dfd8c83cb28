// Sentences from the service. They mark code with backticks.

import { h } from "../../dom.js";

/** Split a sentence into texts and code. */
export function prose(text) {
  return text.split("`").map((part, index) => (index % 2 ? h("code", {}, part) : part));
}

/** Return a banner with warnings; null if there are none. */
export function warningBanner(texts) {
  return texts.length ? h("section", { class: "banner", "aria-label": "Warnings" }, h("strong", {}, "Warnings"), sentences(texts)) : null;
}

/** Return a list of sentences. */
export function sentences(texts) {
  return h("ul", {}, texts.map((text) => h("li", {}, prose(text))));
}
