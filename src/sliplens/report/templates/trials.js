// Sorts the rows by a column: numbers by their value, what has none last; a second click turns the order round.
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const head = button.closest("th"), body = head.closest("table").tBodies[0];
    const falling = head.getAttribute("aria-sort") === "ascending", turn = falling ? -1 : 1;
    const value = (row) => row.cells[head.cellIndex].dataset.value;
    const compare = (one, other) => {
      const a = value(one), b = value(other), x = Number(a), y = Number(b);
      if (a === "nan" || b === "nan") return (a === "nan") - (b === "nan");
      return turn * (Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b, undefined, { numeric: true }) : x - y);
    };
    for (const other of head.parentElement.cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", falling ? "descending" : "ascending");
    body.append(...[...body.rows].sort(compare));
  });
}
