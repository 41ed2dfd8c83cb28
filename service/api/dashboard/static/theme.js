// Light or dark before anything is drawn; no module, as those run too late and the page would flash.
"use strict";
(() => {
  const root = document.documentElement;
  const kept = localStorage.getItem("lipserve-theme");
  root.dataset.theme = kept === "light" || kept === "dark" ? kept : "auto";
})();
