// Layout audit of the page: returns a sentence for each text or control that overlaps another, is cut, or leaves its card or the page.
() => {
  const TOLERANCE = 2; // px
  const problems = new Set(), root = document.documentElement;
  const isShown = (node) => {
    if (!node.checkVisibility({visibilityProperty: true})) return false;
    for (let at = node; at; at = at.parentElement) {
      const style = getComputedStyle(at);
      if (Number(style.opacity) === 0 || style.clipPath !== 'none') return false; // hidden, or only for screen readers
    }
    return true;
  };
  const words = (text) => text.trim().replace(/\s+/g, ' ').slice(0, 50);
  const name = (node) => {
    const named = words(node.textContent || node.getAttribute('aria-label') || node.getAttribute('placeholder') || '');
    const kind = node.getAttribute('class')?.trim().split(/\s+/).join('.');
    return `“${named}” (${node.tagName.toLowerCase()}${kind ? `.${kind}` : ''})`;
  };
  const scrolls = (style) => /auto|scroll/.test(style.overflowX) || /auto|scroll/.test(style.overflowY);
  const cross = (a, b) => ({left: Math.max(a.left, b.left), right: Math.min(a.right, b.right), top: Math.max(a.top, b.top), bottom: Math.min(a.bottom, b.bottom)});
  const hides = (style) => /hidden|clip/.test(`${style.overflowX} ${style.overflowY}`);
  /** The part of a box that its ancestors show; null if there is none. */
  const shownPart = (node, box) => {
    let part = box;
    for (let at = node; at && at !== root; at = at.parentElement) {
      const style = getComputedStyle(at);
      if (scrolls(style) || hides(style)) part = cross(part, at.getBoundingClientRect());
    }
    return part.right - part.left > 1 && part.bottom - part.top > 1 ? part : null;
  };
  const isFloating = (node) => {
    for (let at = node; at; at = at.parentElement) if (/fixed|sticky/.test(getComputedStyle(at).position)) return true;
    return false;
  };
  const titled = (node) => node.closest('[title]') || node.querySelector(':scope > title');

  if (root.scrollWidth > root.clientWidth) problems.add(`the page is ${root.scrollWidth - root.clientWidth} px wider than the window`);

  // texts: one box for each line of a text node; one for each text of an SVG, whose axis titles are rotated
  const pieces = [];
  const add = (node, box) => {
    const part = box.width > 1 && box.height > 1 && shownPart(node, box);
    if (part) pieces.push({node, box, part});
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let text = walker.nextNode(); text; text = walker.nextNode()) {
    const node = text.parentElement;
    if (!text.data.trim() || node.closest('svg, script, style, option, textarea') || !isShown(node)) continue;
    const range = document.createRange();
    range.selectNodeContents(text);
    for (const box of range.getClientRects()) add(node, box);
  }
  const isPlain = (text) => !text.closest('.hoverlayer, .cursor-pointer, defs');
  for (const text of document.querySelectorAll('svg text'))
    if (text.textContent.trim() && isPlain(text) && isShown(text)) add(text, text.getBoundingClientRect());
  const texts = [...pieces];
  for (const node of document.querySelectorAll('button, .button, input, select, textarea, canvas, progress, .badge, .inside, .stack, .bars, .course, .arm-sketch'))
    if (isShown(node) && !node.closest('.gl-container, .plotly')) add(node, node.getBoundingClientRect());

  // overlaps
  pieces.sort((a, b) => a.part.top - b.part.top);
  for (const [index, one] of pieces.entries())
    for (const other of pieces.slice(index + 1)) {
      if (other.part.top > one.part.bottom - TOLERANCE) break;
      if (one.node.contains(other.node) || other.node.contains(one.node)) continue;
      const {left, right, top, bottom} = cross(one.part, other.part);
      if (right - left <= TOLERANCE || bottom - top <= TOLERANCE || isFloating(one.node) !== isFloating(other.node)) continue;
      problems.add(`${name(one.node)} and ${name(other.node)} overlap by ${Math.round(right - left)} x ${Math.round(bottom - top)} px`);
    }

  // texts and controls beyond the page, their card, or another box with a border or background
  const isBox = (node) => {
    const style = getComputedStyle(node);
    if (style.display === 'inline' || style.display === 'contents') return false;
    return node.matches('.card') || style.borderLeftStyle !== 'none' && parseFloat(style.borderLeftWidth) > 0 || !/^rgba\(.*, 0\)$/.test(style.backgroundColor);
  };
  for (const {node, part} of pieces) {
    if (node.closest('.skip') || isFloating(node)) continue;
    if (part.left < -1 || part.right > root.clientWidth + 1) problems.add(`${name(node)} reaches beyond the page: ${Math.round(part.left)} to ${Math.round(part.right)} of ${root.clientWidth} px`);
    let around = node.matches('button, .button, input, select, textarea, canvas, progress, .badge') ? node.parentElement : node;
    while (around && around !== root && !isBox(around)) around = around.parentElement;
    if (!around || around === root || node.closest('svg')) continue;
    const box = around.getBoundingClientRect();
    if (scrolls(getComputedStyle(around))) continue;
    const beyond = Math.max(box.left - part.left, part.right - box.right, box.top - part.top, part.bottom - box.bottom);
    if (beyond > TOLERANCE) problems.add(`${name(node)} reaches ${Math.round(beyond)} px beyond ${name(around)}`);
  }

  // texts that are cut: by `overflow`, by the frame of a drawing, or inside a select or a placeholder
  for (const {node, box} of texts) {
    const frame = node.closest('svg');
    for (let at = frame ?? node; at && at !== document.body && !scrolls(getComputedStyle(at)); at = at.parentElement) {
      if (!hides(getComputedStyle(at)) || titled(at) || titled(node)) continue;
      const edge = at.getBoundingClientRect();
      const cut = Math.max(edge.left - box.left, box.right - edge.right, edge.top - box.top, box.bottom - edge.bottom);
      if (cut > TOLERANCE) problems.add(`${name(node)} is cut by ${Math.round(cut)} px`);
    }
  }
  const pen = document.createElement('canvas').getContext('2d');
  for (const node of document.querySelectorAll('select, input[placeholder]')) {
    if (!isShown(node) || titled(node)) continue;
    const style = getComputedStyle(node), text = node.tagName === 'SELECT' ? node.selectedOptions[0]?.textContent : node.placeholder;
    pen.font = `${style.fontWeight} ${style.fontSize} ${style.fontFamily}`;
    const arrow = node.tagName === 'SELECT' ? 16 : 0, room = node.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight) - arrow;
    if (pen.measureText(text?.trim() ?? '').width > room + 1) problems.add(`“${words(text)}” is cut in its ${node.tagName.toLowerCase()} ${node.getAttribute('aria-label') ?? node.labels?.[0]?.textContent ?? ''}`);
  }
  return [...problems];
}
