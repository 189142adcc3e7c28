// Before the first paint: the colours the reader chose last.
"use strict";
(() => {
  const kept = (() => { try { return localStorage.getItem("squealcast-theme"); } catch { return null; } })();
  if (kept === "light" || kept === "dark") document.documentElement.dataset.theme = kept;
})();
