// Whether a version may answer, and why: judged by what its training held out.

import { h } from "../../dom.js";

/** What came of a version's judgement; nothing of one that was refreshed or came with LIPServe. */
export function promoted({ version, promotion }) {
  if (!promotion) return null;
  if (promotion.passed) return h("p", { class: "hint" }, `It answers by itself: ${promotion.reason}.`);
  const doubt = promotion.passed === null ? "is not known to do well" : "did not do well";
  const what = promotion.answers ? `Version ${version} answered, though it ${doubt} on what was held out` : `Version ${version} waits as candidate and did not answer by itself`;
  return h("div", { class: "banner", role: "note" }, h("strong", {}, `${what}: `), `${promotion.reason}.`);
}

/** Whether a version should be let answer, beside the button that does it: {word, kind, why}. */
export function mayAnswer({ promotion }) {
  if (!promotion) return { word: "not judged", kind: "plain", why: "It was refreshed or came with LIPServe. Compare it on a recording first" };
  const { passed, reason } = promotion;
  if (passed === null) return { word: "not judged", kind: "plain", why: capital(reason) };
  return passed ? { word: "may answer", kind: "good", why: capital(reason) } : { word: "should not answer", kind: "warn", why: capital(reason) };
}

function capital(text) {
  return `${text.slice(0, 1).toUpperCase()}${text.slice(1)}`;
}
