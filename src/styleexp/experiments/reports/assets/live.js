"use strict";
// Reloads the page of a run that goes, and says so if nobody has written it for long.
(() => {
  const page = document.getElementById("live");
  if (page.dataset.goes !== "1") return;
  const wait = Number(page.dataset.wait);
  const since = (stamp) => Math.max(0, Math.round(Date.now() / 1000 - Number(stamp)));
  const told = (seconds) => seconds < 100 ? `${seconds} s` : `${Math.round(seconds / 60)} min`;
  const elapsed = document.getElementById("elapsed");
  const silent = document.getElementById("silent");
  const show = () => {
    elapsed.textContent = `(${told(since(page.dataset.started))})`;
    const quiet = since(page.dataset.written);
    silent.hidden = quiet < 300;
    silent.textContent = `Nothing new for ${told(quiet)}: if no styleexp is running, the run was ended from outside.`;
  };
  show();
  setInterval(show, 1000);
  setTimeout(() => location.reload(), 1000 * wait);
})();
