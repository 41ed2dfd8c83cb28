// Creates and updates elements. Text is never parsed as HTML.

const SVG = "http://www.w3.org/2000/svg";
const SVG_TAGS = new Set(["svg", "path", "circle", "rect", "line", "polyline", "title", "g"]);
const CONTROLS = new Set(["BUTTON", "INPUT", "SELECT", "TEXTAREA"]);
const withListeners = new WeakSet();

/** Create an element: h("p", {class: "hint", onclick: f}, "text", h("b", {}, "more")). Children may be nested lists; null is skipped. */
export function h(tag, props = {}, ...children) {
  const element = SVG_TAGS.has(tag) ? document.createElementNS(SVG, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(props ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on") && typeof value === "function") {
      element.addEventListener(name.slice(2), value);
      withListeners.add(element);
    } else if (name === "dataset") Object.assign(element.dataset, value);
    else if (name === "style") element.style.cssText = value;
    else if (name === "value" || name === "checked" || name === "selected") element[name] = value;
    else element.setAttribute(name === "className" ? "class" : name, value === true ? "" : String(value));
  }
  return append(element, children);
}

/** Replace all children of an element. */
export function replace(element, ...children) {
  element.replaceChildren();
  return append(element, children);
}

/**
 * Update the children of an element and keep the focus, the scroll position, the selection and a click in progress.
 * A node that matches a new child is kept, and its texts and attributes are changed in place. Links match by their
 * `href`, rows and items by their `data-key`. Only other nodes are inserted or removed.
 * Controls and elements with listeners are never changed: create them once, and pass the same node again.
 */
export function refresh(element, ...children) {
  const wanted = nodes(children);
  const given = new Set(wanted);
  const focused = element.contains(document.activeElement) ? document.activeElement : null;
  const remaining = [...element.childNodes];
  const kept = wanted.map((fresh) => {
    const index = remaining.findIndex((old) => old === fresh || (!given.has(old) && matches(old, fresh)));
    if (index < 0) return fresh;
    const [old] = remaining.splice(index, 1);
    if (old !== fresh) update(old, fresh);
    return old;
  });
  for (const old of remaining) old.remove();
  let next = element.firstChild;
  for (const node of kept) {
    if (node === next) next = next.nextSibling;
    else element.insertBefore(node, next);
  }
  // moving a node removes its focus
  if (focused?.isConnected && focused !== document.activeElement) focused.focus({ preventScroll: true });
  return element;
}

function matches(old, fresh) {
  if (old.nodeName !== fresh.nodeName) return false;
  if (old.nodeType === Node.TEXT_NODE) return true;
  return !isControl(old) && !isControl(fresh) && keyOf(old) === keyOf(fresh);
}

function isControl(element) {
  return CONTROLS.has(element.nodeName) || withListeners.has(element);
}

function keyOf(element) {
  return element.dataset.key ?? element.getAttribute("href");
}

function update(old, fresh) {
  if (old.nodeType === Node.TEXT_NODE) {
    if (old.data !== fresh.data) old.data = fresh.data;
    return;
  }
  const kept = old.nodeName === "DETAILS" ? "open" : null; // the reader opened it
  for (const { name } of [...old.attributes]) if (!fresh.hasAttribute(name) && name !== kept) old.removeAttribute(name);
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
