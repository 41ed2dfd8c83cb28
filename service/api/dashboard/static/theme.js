// Sets the theme before the first paint. Not a module: modules run later, and the page would flash.
"use strict";
(() => {
  const root = document.documentElement;
  const kept = localStorage.getItem("lipserve-theme");
  root.dataset.theme = kept === "light" || kept === "dark" ? kept : "auto";
})();
