// Press a picture: it opens large. On a page with several, another one can be put beside it to compare.
"use strict";
(function () {
  const pictures = [...document.querySelectorAll("article img:not(.jp-OutputArea img)")].filter((one) => one.alt);
  if (!pictures.length || !window.HTMLDialogElement) return;
  const name = (picture) => picture.alt.split(":")[0];
  const dialog = document.createElement("dialog");
  dialog.className = "large";
  dialog.innerHTML =
    '<header><button class="back" aria-label="previous picture">&larr;</button>' +
    '<button class="on" aria-label="next picture">&rarr;</button><b></b>' +
    '<label>beside it: <select></select></label><button class="close">Close</button></header><div></div>';
  document.body.append(dialog);
  const [back, on, close] = ["back", "on", "close"].map((one) => dialog.querySelector("." + one));
  const beside = dialog.querySelector("select");
  const place = dialog.querySelector("div");
  let shown = 0;

  const draw = () => {
    const chosen = beside.value === "" ? [shown] : [shown, Number(beside.value)];
    place.replaceChildren(...chosen.map((index) => {
      const large = new Image();
      large.src = pictures[index].src;
      large.alt = pictures[index].alt;
      return large;
    }));
    dialog.querySelector("b").textContent = chosen.map((index) => name(pictures[index])).join("   |   ");
  };
  beside.add(new Option("nothing", ""));
  pictures.forEach((picture, index) => beside.add(new Option(name(picture), String(index))));
  const step = (by) => { shown = (shown + by + pictures.length) % pictures.length; draw(); };
  back.onclick = () => step(-1);
  on.onclick = () => step(1);
  close.onclick = () => dialog.close();
  beside.onchange = draw;
  for (const one of [back, on, beside.parentElement]) one.hidden = pictures.length < 2;
  dialog.addEventListener("click", (event) => { if (event.target === dialog || event.target === place) dialog.close(); });
  dialog.addEventListener("keydown", (event) => {
    if (event.target === beside) return;
    if (event.key === "ArrowLeft") step(-1);
    if (event.key === "ArrowRight") step(1);
  });
  pictures.forEach((picture, index) => {
    const link = picture.closest("a");
    if (link && !/\.png$/.test(link.getAttribute("href"))) return; // it leads to a page
    picture.classList.add("opens");
    (link || picture).addEventListener("click", (event) => {
      event.preventDefault();
      shown = index;
      draw();
      dialog.showModal();
      on.focus();
    });
  });
})();
