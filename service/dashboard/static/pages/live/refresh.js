// Brings what is shown up to date without taking away what somebody has focused, scrolled or marked.

/** Make a place show these nodes: texts are changed where the structure is the same, else parts are replaced. */
export function refresh(place, ...fresh) {
  const wanted = fresh.filter((node) => node !== null && node !== undefined);
  if (place.childNodes.length !== wanted.length) {
    place.replaceChildren(...wanted);
    return;
  }
  wanted.forEach((node, index) => mend(place.childNodes[index], node));
}

function mend(old, fresh) {
  if (old.nodeType !== fresh.nodeType || old.nodeName !== fresh.nodeName) {
    old.replaceWith(fresh);
    return;
  }
  if (old.nodeType === Node.TEXT_NODE) {
    if (old.data !== fresh.data) old.data = fresh.data;
    return;
  }
  for (const { name, value } of fresh.attributes) if (old.getAttribute(name) !== value) old.setAttribute(name, value);
  refresh(old, ...fresh.childNodes);
}
