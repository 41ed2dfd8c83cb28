// Sentences of the service, whose `code` stands between backticks.

import { h } from "../../dom.js";

/** The parts of a sentence: texts, and code where it stands between backticks. */
export function prose(text) {
  return text.split("`").map((part, index) => (index % 2 ? h("code", {}, part) : part));
}

/** What to be careful with, in a frame; nothing where there is nothing. */
export function warned(texts) {
  return texts.length ? h("section", { class: "banner", "aria-label": "Warnings" }, h("strong", {}, "Warnings"), sentences(texts)) : null;
}

/** Sentences as a list. */
export function sentences(texts) {
  return h("ul", {}, texts.map((text) => h("li", {}, prose(text))));
}
