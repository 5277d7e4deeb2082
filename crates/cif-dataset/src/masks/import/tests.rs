use super::coverage::Coverage;
use super::{brush, polygon, runs};

/// Places that something covers.
fn covered(
    size: (u32, u32),
    cover: impl FnOnce(&mut Coverage) -> Result<(), String>,
) -> Result<Vec<usize>, String> {
    let mut coverage = Coverage::none(size);
    cover(&mut coverage)?;
    Ok(coverage.places().collect())
}

fn runs_covered(code: &runs::Code, size: (u32, u32)) -> Result<Vec<usize>, String> {
    covered(size, |coverage| runs::cover(code, coverage))
}

fn brush_covered(bytes: &[u8], size: (u32, u32)) -> Result<Vec<usize>, String> {
    covered(size, |coverage| brush::cover(bytes, coverage))
}

fn filled(outlines: &[Vec<[f64; 2]>], size: (u32, u32)) -> Vec<usize> {
    covered(size, |coverage| {
        polygon::cover(outlines, coverage);
        Ok(())
    })
    .unwrap()
}

#[test]
fn coverage_counts_pixels_once_across_words() {
    let mut coverage = Coverage::none((100, 2));
    for places in [60..70, 63..64, 0..1, 128..192, 199..200, 5..5] {
        coverage.add(places);
    }
    assert_eq!(coverage.count(), 10 + 1 + 64 + 1);
    let expected: Vec<usize> = [0].into_iter().chain(60..70).chain(128..192).chain([199]).collect();
    assert_eq!(coverage.places().collect::<Vec<_>>(), expected);
    coverage.clear();
    assert_eq!(coverage.count(), 0);
}

#[test]
fn the_text_of_coco_gives_its_runs() {
    // Columns 0011, 1100, 0001, as pycocotools 2.0 writes them: runs 2, 4, 5, 1, the last as its difference to the
    // second, -3.
    assert_eq!(runs::from_text("245M").unwrap(), [2, 4, 5, 1]);
    assert!(runs::from_text("000N").unwrap_err().contains("negative"));
    // 100 = 4 + 3 * 32: `T3`; the fourth run is a difference to the second.
    assert_eq!(runs::from_text("T34T3N").unwrap(), [100, 4, 100, 2]);
    assert!(runs::from_text("T").unwrap_err().contains("stops inside"));
    assert!(runs::from_text("~").unwrap_err().contains("no letter"));
}

#[test]
fn columns_become_rows_and_runs_must_fill_the_picture() {
    // Height 2, width 3: columns 01, 11, 00.
    let code = runs::Code::Columns(vec![1, 3, 2]);
    assert_eq!(runs_covered(&code, (3, 2)).unwrap(), [1, 3, 4]);
    for counts in [vec![1, 3], vec![1, 3, 3], vec![u64::MAX, 2]] {
        let message = runs_covered(&runs::Code::Columns(counts), (3, 2)).unwrap_err();
        assert!(message.contains("broken run-length code"), "{message}");
    }
    let boxed = |left| runs::Code::Box { left, top: 1, width: 2, height: 1, counts: vec![1, 1] };
    assert_eq!(runs_covered(&boxed(1), (3, 2)).unwrap(), [5]);
    assert!(runs_covered(&boxed(2), (3, 2)).unwrap_err().contains("leaves the picture"));
    assert!(runs_covered(&boxed(u32::MAX), (3, 2)).unwrap_err().contains("leaves the picture"));
}

#[test]
fn a_brush_gives_its_opaque_pixels() {
    // 2 x 1 pixels: the first transparent, the second opaque, as eight single values and as runs.
    let bits = |text: &str| -> Vec<u8> {
        let digits: Vec<u8> = text.bytes().filter(u8::is_ascii_digit).map(|digit| digit - b'0').collect();
        digits
            .chunks(8)
            .map(|byte| byte.iter().enumerate().fold(0, |value, (k, bit)| value | bit << (7 - k)))
            .collect()
    };
    let head = format!("{:032b} 00111 0010 0011 0111 1111", 8);
    let runs = bits(&format!("{head} 1 00 011 00000000 1 01 0011 11111111"));
    assert_eq!(brush_covered(&runs, (2, 1)).unwrap(), [1]);
    let singles = bits(&format!("{head} 0 00 111 {}", "00000000".repeat(7) + "00000001"));
    assert_eq!(brush_covered(&singles, (2, 1)).unwrap(), [1]);
    assert!(brush_covered(&runs[..8], (2, 1)).unwrap_err().contains("cut short"));
    assert!(brush_covered(&runs, (3, 1)).unwrap_err().contains("8 values"));
    let beyond = bits(&format!("{head} 1 01 1111 00000000"));
    assert!(brush_covered(&beyond, (2, 1)).unwrap_err().contains("beyond"));
}

#[test]
fn polygons_cover_the_pixels_whose_centres_they_hold() {
    let square = polygon::corners(&[1.0, 1.0, 3.0, 1.0, 3.0, 3.0, 1.0, 3.0]).unwrap();
    assert_eq!(filled(&[square], (4, 4)), [5, 6, 9, 10]);
    // Centres at 0.5 are inside from 0.4 on and outside from 0.6 on; what leaves the picture is cut.
    let shifted = polygon::corners(&[-9.0, 0.4, 0.6, 0.4, 0.6, 1.4, -9.0, 1.4]).unwrap();
    assert_eq!(filled(&[shifted], (4, 4)), [0]);
    // A hole by the even-odd rule, and two outlines that overlap.
    let bow = polygon::corners(&[
        0.0, 0.0, 4.0, 0.0, 4.0, 4.0, 0.0, 4.0, 0.0, 0.0, 1.0, 1.0, 1.0, 3.0, 3.0, 3.0, 3.0, 1.0, 1.0, 1.0,
    ])
    .unwrap();
    assert_eq!(filled(std::slice::from_ref(&bow), (4, 4)).len(), 12);
    let middle = polygon::corners(&[1.0, 0.0, 3.0, 0.0, 3.0, 4.0, 1.0, 4.0]).unwrap();
    assert_eq!(filled(&[bow, middle], (4, 4)), (0..16).collect::<Vec<_>>());
    assert!(polygon::corners(&[0.0, 0.0, 1.0, 1.0]).is_err());
    assert!(polygon::corners(&[0.0, f64::NAN, 1.0, 1.0, 2.0, 2.0]).is_err());
}
