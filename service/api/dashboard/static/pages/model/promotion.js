// Result of a version's promotion check on held-out rows.

import { h } from "../../dom.js";
import { sentence } from "../../format.js";

/** Return a note on the promotion of a version; null if it was retrained automatically or shipped with LIPServe. */
export function promotionNote({ version, promotion }) {
  if (!promotion) return null;
  const reason = sentence(promotion.reason);
  if (promotion.passed) return h("p", { class: "hint" }, `Held-out check passed. ${reason}`);
  const check = promotion.passed === null ? "the held-out check was inconclusive" : "it failed the held-out check";
  const state = promotion.answers ? `Version ${version} was promoted, although ${check}.` : `Version ${version} is a candidate: ${check}.`;
  return h("div", { class: "banner", role: "note" }, h("strong", {}, state), ` ${reason}`);
}

/** Return label and kind of a badge for the promotion check of a version, and its reason: {word, kind, why}. */
export function promotionCheck({ promotion }) {
  if (!promotion) return { word: "not evaluated", kind: "plain", why: "Retrained automatically or shipped with LIPServe. Compare it on a recording first." };
  const { passed, reason } = promotion;
  if (passed === null) return { word: "inconclusive", kind: "plain", why: sentence(reason) };
  return passed ? { word: "passed", kind: "good", why: sentence(reason) } : { word: "failed", kind: "warn", why: sentence(reason) };
}
