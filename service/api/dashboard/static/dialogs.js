// What appears beside the page: a question that must be answered, and notices in a corner.

import { html, render } from "./preact.js";

/**
 * Show a modal dialog; return its return value once it is closed: the value of the button, "" after Escape.
 * content: of the dialog, with a form of the method "dialog"; attributes: of the dialog; onclose(dialog): before it goes.
 */
export function ask(content, attributes = {}, onclose = () => {}) {
  return new Promise((resolve) => {
    const place = document.createElement("div");
    document.body.append(place);
    const end = ({ target: box }) => {
      onclose(box);
      render(null, place);
      place.remove();
      resolve(box.returnValue);
    };
    render(html`<dialog ...${attributes} onClose=${end}>${content}</dialog>`, place);
    const box = place.firstChild;
    box.showModal();
    box.querySelector("[data-first]")?.focus();
  });
}

/** Ask for confirmation before an action that cannot be undone or that affects robots; return whether to proceed. */
export async function confirm(question, label = "Continue", kind = "danger") {
  const form = html`<form method="dialog">
    <p>${question}</p>
    <div class="actions">
      <button class=${kind} value="yes">${label}</button>
      <button value="no" data-first>Cancel</button>
    </div>
  </form>`;
  return (await ask(form, { "aria-label": label })) === "yes";
}

/** Show a notice in a corner of the page; kind: good, bad or plain. A bad one stays until it is closed. */
export function notice(text, kind = "good") {
  const place = document.createElement("div");
  document.getElementById("notices").append(place);
  const close = () => place.remove();
  render(html`<div class=${`notice ${kind}`}><span>${text}</span><button type="button" aria-label="Close" onClick=${close}>×</button></div>`, place);
  if (kind !== "bad") setTimeout(close, 6000);
}
