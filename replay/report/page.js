"use strict";
// Shows the frame at the position of a plot that the pointer or the arrow keys select.
const frames = JSON.parse(document.getElementById("frames").textContent);

function nearest(places, x) {
  let best = 0;
  for (let i = 1; i < places.length; i++)
    if (Math.abs(places[i] - x) < Math.abs(places[best] - x)) best = i;
  return best;
}

for (const plot of document.querySelectorAll("[data-frames]")) {
  const images = frames[plot.dataset.frames];
  const area = plot.querySelector(".area"), tip = plot.querySelector(".tip");
  const cursor = plot.querySelector(".cursor"), canvas = tip.querySelector("canvas");
  const caption = tip.querySelector("span"), sheet = new Image();
  let at = -1;
  if (images.source) sheet.src = images.source;
  else canvas.remove();

  function show(i) {
    at = i;
    const box = area.getBoundingClientRect(), x = images.x[i] / 1000 * box.width;
    plot.setAttribute("aria-valuenow", String(i + 1));
    plot.setAttribute("aria-valuetext", images.text[i]);
    caption.textContent = images.text[i];
    if (images.source) {
      const zoom = Math.max(1, Math.round(192 / images.width));
      canvas.width = images.width * zoom;
      canvas.height = images.height * zoom;
      const pen = canvas.getContext("2d");
      pen.imageSmoothingEnabled = false;
      pen.drawImage(sheet, i % images.columns * images.width,
        Math.floor(i / images.columns) * images.height, images.width, images.height,
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
  function showAtPointer(event) {
    const box = area.getBoundingClientRect();
    show(nearest(images.x, (event.clientX - box.left) / box.width * 1000));
  }
  sheet.addEventListener("load", () => { if (tip.style.display === "block") show(at); });
  area.addEventListener("pointermove", showAtPointer);
  area.addEventListener("pointerdown", showAtPointer);
  area.addEventListener("pointerleave", () => { if (document.activeElement !== plot) hide(); });
  plot.addEventListener("focus", () => show(Math.max(at, 0)));
  plot.addEventListener("blur", hide);
  plot.addEventListener("keydown", event => {
    const last = images.x.length - 1;
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
