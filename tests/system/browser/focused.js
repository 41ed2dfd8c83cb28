// Returns the focused element: its name, and whether the focus is visible and in view; null if there is none.
() => {
  const node = document.activeElement;
  if (!node || node === document.body) return null;
  const style = getComputedStyle(node);
  const ring = (style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) >= 1) || style.boxShadow !== 'none';
  const box = node.getBoundingClientRect();
  return {
    name: (node.getAttribute('aria-label') || [...(node.labels || [])].map((label) => label.textContent).join(' ')
      || node.textContent || '').trim().replace(/\s+/g, ' '),
    tag: node.tagName.toLowerCase(), ring, inView: box.bottom > 0 && box.top < innerHeight,
  };
}
