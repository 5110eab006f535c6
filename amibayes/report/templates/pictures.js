"use strict";
// Pictures in dark mode: what is grey is turned from black on white to light on the card, what has
// a colour keeps it, and edges in between follow. One drawing serves both, and paper stays white.
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const COLOURED = 90;  // difference of channels from which a pixel keeps its colour
  const turned = (image, card) => {
    const canvas = document.createElement("canvas");
    canvas.width = image.naturalWidth;
    canvas.height = image.naturalHeight;
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    const picture = context.getImageData(0, 0, canvas.width, canvas.height), p = picture.data;
    for (let k = 0; k < p.length; k += 4) {
      const high = Math.max(p[k], p[k + 1], p[k + 2]), low = Math.min(p[k], p[k + 1], p[k + 2]);
      const keep = Math.min(1, (high - low) / COLOURED), grey = (p[k] + p[k + 1] + p[k + 2]) / 3;
      for (let c = 0; c < 3; c++) {
        const other = 232 + (card[c] - 232) * grey / 255;
        p[k + c] = keep * p[k + c] + (1 - keep) * other;
      }
    }
    context.putImageData(picture, 0, 0);
    return canvas;
  };
  const channels = (name) => {
    const text = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    return [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16));
  };
  const images = [...document.querySelectorAll(".figures img")];
  const light = new Map(images.map((image) => [image, image.src]));
  const made = new Map();
  const show = (image, isDark) => {
    image.classList.toggle("dark", isDark && made.has(image));
    image.src = isDark && made.has(image) ? made.get(image) : light.get(image);
  };
  const darken = (image) => {
    if (made.has(image)) return show(image, dark.matches);
    const source = new Image();
    source.onload = () => turned(source, channels("--card")).toBlob((blob) => {
      made.set(image, URL.createObjectURL(blob));
      show(image, dark.matches);
    });
    source.src = light.get(image);
  };
  // A picture is turned when it comes near the screen: a page of twenty opens at once.
  const near = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting && dark.matches) darken(entry.target);
  }, { rootMargin: "1500px" });
  images.forEach((image) => near.observe(image));
  dark.addEventListener("change", () => images.forEach((image) => {
    if (!dark.matches) return show(image, false);
    near.unobserve(image);
    near.observe(image);
  }));
  addEventListener("beforeprint", () => images.forEach((image) => show(image, false)));
  addEventListener("afterprint", () => images.forEach((image) => show(image, dark.matches)));
})();
