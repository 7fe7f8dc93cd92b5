"use strict";
// Shows the frame that belongs to the place of a plot at which one points, or goes by keys.
const frames = JSON.parse(document.getElementById("frames").textContent);

function nearest(places, x) {
  let best = 0;
  for (let i = 1; i < places.length; i++)
    if (Math.abs(places[i] - x) < Math.abs(places[best] - x)) best = i;
  return best;
}

for (const plot of document.querySelectorAll("[data-frames]")) {
  const shown = frames[plot.dataset.frames];
  const area = plot.querySelector(".area"), tip = plot.querySelector(".tip");
  const cursor = plot.querySelector(".cursor"), canvas = tip.querySelector("canvas");
  const said = tip.querySelector("span"), picture = new Image();
  let at = -1;
  if (shown.source) picture.src = shown.source;
  else canvas.remove();

  function show(i) {
    at = i;
    const box = area.getBoundingClientRect(), x = shown.x[i] / 1000 * box.width;
    plot.setAttribute("aria-valuenow", String(i + 1));
    plot.setAttribute("aria-valuetext", shown.text[i]);
    said.textContent = shown.text[i];
    if (shown.source) {
      const zoom = Math.max(1, Math.round(192 / shown.width));
      canvas.width = shown.width * zoom;
      canvas.height = shown.height * zoom;
      const pen = canvas.getContext("2d");
      pen.imageSmoothingEnabled = false;
      pen.drawImage(picture, i % shown.columns * shown.width,
        Math.floor(i / shown.columns) * shown.height, shown.width, shown.height,
        0, 0, canvas.width, canvas.height);
    }
    tip.style.display = cursor.style.display = "block";
    cursor.style.left = x + "px";
    cursor.style.height = area.querySelector("svg").getBoundingClientRect().height + "px";
    tip.style.left = Math.max(Math.min(x + 12, box.width - tip.offsetWidth), -40) + "px";
    tip.style.top = "100%";
  }
  function hide() {
    tip.style.display = cursor.style.display = "none";
  }
  function pointed(event) {
    const box = area.getBoundingClientRect();
    show(nearest(shown.x, (event.clientX - box.left) / box.width * 1000));
  }
  picture.addEventListener("load", () => { if (tip.style.display === "block") show(at); });
  area.addEventListener("pointermove", pointed);
  area.addEventListener("pointerdown", pointed);
  area.addEventListener("pointerleave", () => { if (document.activeElement !== plot) hide(); });
  plot.addEventListener("focus", () => show(Math.max(at, 0)));
  plot.addEventListener("blur", hide);
  plot.addEventListener("keydown", event => {
    const last = shown.x.length - 1;
    const to = {
      ArrowRight: at + 1, ArrowUp: at + 1, ArrowLeft: at - 1, ArrowDown: at - 1,
      Home: 0, End: last,
    }[event.key];
    if (event.key === "Escape") hide();
    if (to === undefined) return;
    event.preventDefault();
    show(Math.min(Math.max(to, 0), last));
  });
}

addEventListener("beforeprint", () => {
  for (const folded of document.querySelectorAll("details")) folded.open = true;
});
