// Runs before the first paint: applies the theme that the user chose last.
"use strict";
(() => {
  const kept = (() => { try { return localStorage.getItem("squealcast-theme"); } catch { return null; } })();
  if (kept === "light" || kept === "dark") document.documentElement.dataset.theme = kept;
})();
