// Shows an error instead of an empty page if a module of the dashboard cannot be loaded.

addEventListener("error", ({ target }) => {
  if (!(target instanceof HTMLScriptElement) || target.type !== "module") return;
  const text = "The dashboard cannot be loaded: its libraries are missing. Install LIPServe from a wheel, or reinstall it where npm's registry can be reached.";
  document.getElementById("main").replaceChildren(Object.assign(document.createElement("p"), { className: "alone", textContent: text }));
}, true);
