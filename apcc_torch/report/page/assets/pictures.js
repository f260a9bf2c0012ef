// Figures and films of runs, where the page holds them.

const picturesOf = (row) => data.pictures[row] ?? [];

function pictureElement(picture, row, caption = picture.caption) {
  const words = `${picture.caption}, run ${names[row]}`;
  let content;
  if (picture.film && picture.uri.startsWith("data:video")) {
    content = make("video", { src: picture.uri, controls: true, loop: true, muted: true, playsinline: true, preload: "metadata", "aria-label": words });
  } else {
    const size = picture.width ? { width: picture.width, height: picture.height } : {};
    content = make("button", { type: "button", title: "Enlarge", onclick: () => enlarge(picture.uri, words) }, make("img", { src: picture.uri, alt: words, ...size }));
  }
  return make("figure", { class: "picture", "data-figure": picture.name, "data-run-row": row }, content, make("figcaption", {}, caption));
}

function enlarge(uri, words) {
  const dialog = byId("large");
  const image = dialog.querySelector("img");
  image.src = uri;
  image.alt = words;
  dialog.showModal();
}

function absent(row) {
  const why = statuses[row] !== "complete"
    ? `No figures: the run is ${statuses[row] === "failed" ? "a failed one" : statuses[row]}.`
    : data.folders.includes(row)
      ? `This page leaves out this run's figures, to stay small. For a page of its own: python -m apcc_torch.report with the folder ${names[row]}`
      : "No figures: the run kept no trajectory.";
  return make("p", { class: "absent" }, why);
}

function startPictures() {
  const dialog = byId("large");
  dialog.querySelector("button").addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
}
