// Elements from plain calls. Text is always text: nothing from the service is ever parsed as HTML.

const SVG = "http://www.w3.org/2000/svg";
const SVG_TAGS = new Set(["svg", "path", "circle", "rect", "line", "polyline", "title", "g"]);
const CONTROLS = new Set(["BUTTON", "INPUT", "SELECT", "TEXTAREA"]);
const listening = new WeakSet();

/** An element: h("p", {class: "hint", onclick: f}, "text", h("b", {}, "more")). Children may be nested lists, null is left out. */
export function h(tag, props = {}, ...children) {
  const element = SVG_TAGS.has(tag) ? document.createElementNS(SVG, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(props ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on") && typeof value === "function") {
      element.addEventListener(name.slice(2), value);
      listening.add(element);
    } else if (name === "dataset") Object.assign(element.dataset, value);
    else if (name === "style") element.style.cssText = value;
    else if (name === "value" || name === "checked" || name === "selected") element[name] = value;
    else element.setAttribute(name === "className" ? "class" : name, value === true ? "" : String(value));
  }
  return append(element, children);
}

/** Put these children in the place of all that an element has. */
export function replace(element, ...children) {
  element.replaceChildren();
  return append(element, children);
}

/**
 * Bring what an element shows up to date without taking away what somebody has focused, scrolled, marked or begun to press.
 * What is there again stays the node that it was, and its texts and attributes are changed in place: a link where it
 * leads to the same place, a row or item where its `data-key` is the same. Only what has come or gone is put in or taken out.
 * What listens or is typed into is never made over: make such a control once, and give the same node again, as a child.
 */
export function refresh(element, ...children) {
  const wanted = nodes(children);
  const given = new Set(wanted);
  const focused = element.contains(document.activeElement) ? document.activeElement : null;
  const left = [...element.childNodes];
  const stays = wanted.map((fresh) => {
    const index = left.findIndex((old) => old === fresh || (!given.has(old) && alike(old, fresh)));
    if (index < 0) return fresh;
    const [old] = left.splice(index, 1);
    if (old !== fresh) mend(old, fresh);
    return old;
  });
  for (const old of left) old.remove();
  let next = element.firstChild;
  for (const node of stays) {
    if (node === next) next = next.nextSibling;
    else element.insertBefore(node, next);
  }
  // a node that was moved has lost it
  if (focused?.isConnected && focused !== document.activeElement) focused.focus({ preventScroll: true });
  return element;
}

function alike(old, fresh) {
  if (old.nodeName !== fresh.nodeName) return false;
  if (old.nodeType === Node.TEXT_NODE) return true;
  return !own(old) && !own(fresh) && key(old) === key(fresh);
}

function own(element) {
  return CONTROLS.has(element.nodeName) || listening.has(element);
}

function key(element) {
  return element.dataset.key ?? element.getAttribute("href");
}

function mend(old, fresh) {
  if (old.nodeType === Node.TEXT_NODE) {
    if (old.data !== fresh.data) old.data = fresh.data;
    return;
  }
  const readers = old.nodeName === "DETAILS" ? "open" : null; // who reads has opened it
  for (const { name } of [...old.attributes]) if (!fresh.hasAttribute(name) && name !== readers) old.removeAttribute(name);
  for (const { name, value } of fresh.attributes) if (old.getAttribute(name) !== value) old.setAttribute(name, value);
  refresh(old, ...fresh.childNodes);
}

function append(element, children) {
  element.append(...nodes(children));
  return element;
}

function nodes(children) {
  return children
    .flat(Infinity)
    .filter((child) => child !== null && child !== undefined && child !== false)
    .map((child) => (child instanceof Node ? child : document.createTextNode(String(child))));
}
