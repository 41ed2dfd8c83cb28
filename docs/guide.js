// Keys reach what scrolls: code, and tables, which Material puts into a frame once the page is there.
const reach = () => {
  for (const node of document.querySelectorAll('.md-typeset__scrollwrap, pre > code')) node.tabIndex = 0;
};
new MutationObserver(reach).observe(document.body, {childList: true, subtree: true});
