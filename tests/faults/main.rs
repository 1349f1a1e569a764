fn main(){}
#[test] fn t(){ let _ = turmoil::Builder::new().build(); }
